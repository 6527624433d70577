"""Code of users: modules that `--import` names, files in which a policy stands, and functions that are handed over."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import importlib.util
import inspect
import sys
import traceback
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from edqn_jax.errors import ConfigError

IMPORTED: list[str] = []
"""What this process' command imported with `--import`; commands that go on from it need the same."""


def load_module(name: str) -> ModuleType:
    """Imports a Python file by its path, or a module by its name, also one of the current folder; executed once.

    What a file imports is searched for in its folder, too.

    Args:
        name: a path that ends in .py, or a module.

    Raises:
        ConfigError: if there is none, or it does not load; names the line of the user's file.
    """
    file = Path(name).resolve() if name.endswith(".py") else None
    if file is not None and not file.is_file():
        raise ConfigError(f"there is no file '{name}'")
    folder = str(Path.cwd() if file is None else file.parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        return importlib.import_module(name) if file is None else _module_of(file)
    except (Exception, SystemExit) as error:
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if file is None and missing and f"{name}.".startswith(f"{missing}."):
            raise ConfigError(f"there is no module '{name}'; give a file that ends in .py, or a module") from None
        lines = [each.lineno for each in traceback.extract_tb(error.__traceback__) if each.filename == str(file)]
        at = f", line {lines[-1]}" if lines and not isinstance(error, SyntaxError) else ""
        said = str(error) if isinstance(error, ConfigError) else f"{type(error).__name__}: {error}"
        raise ConfigError(f"'{name}' does not load: {said}{at}"[:300]) from error


def _module_of(file: Path) -> ModuleType:
    """Returns the module of a file: the one of its own name, unless that is another module's."""
    loaded = sys.modules.get(file.stem)
    has_spec = loaded is None or loaded.__spec__ is not None  # `__main__` may have none
    found = importlib.util.find_spec(file.stem) if has_spec and file.stem.isidentifier() else None
    if found is not None and found.origin == str(file):
        return importlib.import_module(file.stem)
    name = f"edqn_user_{file.stem}_{hashlib.sha256(str(file).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None and spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def describe_object(thing: object) -> str:
    """Returns what somebody gave, in a few words."""
    if isinstance(thing, type):
        return f"the class {thing.__name__}"
    if thing is None or isinstance(thing, str | int | float):
        return repr(thing)[:80]
    if inspect.isroutine(thing):
        return f"the function {thing.__name__}"
    return f"an object of the type {type(thing).__name__}"


def check_takes(function: Any, arguments: str, what: str, wanted: str = "a function") -> None:
    """Raises unless something can be called with so many arguments by their place.

    What has no signature, as some functions in C, is taken as it is.

    Args:
        function: to be called.
        arguments: their names, such as `config, key`; empty for none.
        what: it is, for messages.
        wanted: what it must be, before its arguments.

    Raises:
        ConfigError: names what it must take, and what it takes.
    """
    if not callable(function):
        raise ConfigError(f"{what} must be {wanted} ({arguments}), not {describe_object(function)}")
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return
    try:
        signature.bind(*filter(None, arguments.split(", ")))
    except TypeError:
        takes = ", ".join(signature.parameters)
        raise ConfigError(f"{what} must be {wanted} ({arguments}), not one of ({takes})") from None


def check_functions(contract: Any, arguments: Mapping[str, str]) -> None:
    """Raises unless the functions in the fields of a dataclass take their arguments; optional ones may be None.

    Args:
        contract: instance of the dataclass.
        arguments: by field, as of `check_takes`.

    Raises:
        ConfigError: names the field.
    """
    defaults = {field.name: field.default for field in dataclasses.fields(contract)}
    for name, takes in arguments.items():
        function = getattr(contract, name)
        if not (function is None and defaults[name] is None):
            check_takes(function, takes, f"`{name}` of {type(contract).__name__}")
