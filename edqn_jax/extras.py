"""Import of packages that only an extra installs."""

from __future__ import annotations

import importlib
from typing import Any

SINKS = {"tensorboard": ("tensorboardX", "track"), "wandb": ("wandb", "track"), "rerun": ("rerun", "viz")}
"""The package that each sink of metrics needs, and the extra that installs it."""


class MissingPackageError(ImportError):
    """A package of an extra is not installed; the message names the command that installs it."""


def require_extra(package: str, extra: str = "bench") -> Any:
    """Imports and returns a package or module of an extra.

    Args:
        package: its name, with dots.
        extra: which one installs it.

    Raises:
        MissingPackageError: if it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        name = package.split(".")[0]
        if error.name is None or error.name.split(".")[0] != name:
            raise
        raise MissingPackageError(f"{name} is not installed; run pip install 'edqn-jax[{extra}]'") from error
