"""Import of packages that only the extra `bench` installs."""

from __future__ import annotations

import importlib
from typing import Any


class MissingPackageError(ImportError):
    """A package of the extra `bench` is not installed; the message names the command that installs it."""


def require(package: str) -> Any:
    """Imports and returns a package or module of the extra `bench`.

    Raises:
        MissingPackageError: if it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        name = package.split(".")[0]
        if error.name is None or error.name.split(".")[0] != name:
            raise
        raise MissingPackageError(f"{name} is not installed; run pip install 'edqn-jax[bench]'") from error
