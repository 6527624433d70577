"""Modules of users: what `--import` names, and files in which a policy stands."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType

from edqn_jax.errors import ConfigError


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
