"""The version of the package."""

from __future__ import annotations

from importlib import metadata


def package_version() -> str:
    """Returns the installed version of edqn-jax, `0+unknown` in a checkout that is not installed."""
    try:
        return metadata.version("edqn-jax")
    except metadata.PackageNotFoundError:
        return "0+unknown"
