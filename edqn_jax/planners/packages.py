"""Packages of the extra `bench`, which are there or are asked for in a sentence."""

from __future__ import annotations

import importlib
from typing import Any


class MissingPackageError(ImportError):
    """A package of the extra `bench` is not installed; the message is one sentence for people."""


def require(package: str) -> Any:
    """A package or module of the extra `bench`, imported.

    Raises:
        MissingPackageError: if it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        name = package.split(".")[0]
        if error.name is None or error.name.split(".")[0] != name:
            raise
        raise MissingPackageError(f"{name} is not installed; pip install 'edqn-jax[bench]' brings it") from error
