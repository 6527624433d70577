"""Functions in C that XLA calls on CPUs: compiled once for this machine, kept beside compiled programs.

Whoever uses one has the same function in JAX for where there is no compiler, and a test that both agree.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import shlex
import shutil
import subprocess
import tempfile
import threading
from pathlib import Path

import jax

from edqn_jax.parallel.programs import private_folder

SWITCH = "EDQN_JAX_NATIVE"
"""Environment variable; with 0 nothing in C is used."""

_ONE_AT_A_TIME = threading.Lock()

HEADER = Path(__file__).with_name("handler.h")

FLAGS = (
    *("-std=gnu11", "-O3", "-march=native", "-fPIC", "-shared"),
    # What vector instructions need. Comparisons of NaN are never relied on.
    *("-fno-math-errno", "-fno-trapping-math", "-ffinite-math-only", "-fno-signed-zeros"),
)


@functools.cache
def compiler() -> str | None:
    """Returns the C compiler that is used and its version, as its own first line; None where nothing in C is used."""
    command = _command()
    if command is None:
        return None
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        said = subprocess.run([*command, "--version"], capture_output=True, text=True, timeout=20)
        if said.returncode == 0 and said.stdout.strip():
            return said.stdout.strip().splitlines()[0]
    return shlex.join(command)


def _command() -> list[str] | None:
    """Returns the compiler that CC names, `cc` otherwise, with its own options; None where none is to be used."""
    if os.environ.get(SWITCH, "1") == "0":
        return None
    words = shlex.split(os.environ.get("CC", "")) or ["cc"]
    found = shutil.which(words[0])
    return None if found is None else [found, *words[1:]]


def registered(source: Path, targets: tuple[str, ...], definitions: tuple[str, ...] = ()) -> bool:
    """Compiles and loads a source, and registers its handlers with XLA; returns whether that was possible.

    Where there is a compiler and it was not, a warning says why.

    Args:
        source: C, with XLA's header for foreign functions.
        targets: names of its handlers.
        definitions: of the preprocessor, NAME=VALUE.
    """
    with _ONE_AT_A_TIME:
        return _registered(source, targets, definitions)


@functools.cache
def _registered(source: Path, targets: tuple[str, ...], definitions: tuple[str, ...]) -> bool:
    command = _command()
    if command is None:
        return False
    try:
        with contextlib.ExitStack() as scratch:
            # Where nothing can be kept, the file is not needed once it is loaded.
            folder = private_folder() or Path(scratch.enter_context(tempfile.TemporaryDirectory()))
            library = _loaded(command, source, definitions, folder)
        for target in targets:
            jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(getattr(library, target)), platform="cpu")
    except (OSError, AttributeError, subprocess.SubprocessError, jax.errors.JaxRuntimeError) as error:
        said = error.stderr.decode(errors="replace") if isinstance(error, subprocess.CalledProcessError) else str(error)
        first = next(iter(said.strip().splitlines()), type(error).__name__)
        logging.getLogger(__name__).warning(
            "%s could not be compiled or loaded, JAX does its work more slowly: %s", source.name, first
        )
        return False
    return True


def _loaded(command: list[str], source: Path, definitions: tuple[str, ...], folder: Path) -> ctypes.CDLL:
    """Returns the library, compiled in `folder` unless one of the same source, compiler and XLA is kept there."""
    defined = [f"-D{definition}" for definition in definitions]
    headers = [f"-I{folder}" for folder in (jax.ffi.include_dir(), HEADER.parent)]
    command = [*command, *FLAGS, *defined, *headers, str(source), "-lm"]
    told_apart = (command, compiler(), source.read_bytes(), HEADER.read_bytes(), jax.__version__)
    library = folder / f"{source.stem}-{hashlib.sha256(repr(told_apart).encode()).hexdigest()[:16]}.so"
    if library.is_file():
        with contextlib.suppress(OSError):  # a damaged file is made anew
            return ctypes.CDLL(str(library))
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        made = Path(scratch) / library.name
        subprocess.run([*command, "-o", str(made)], check=True, capture_output=True, timeout=60)
        made.replace(library)
    return ctypes.CDLL(str(library))
