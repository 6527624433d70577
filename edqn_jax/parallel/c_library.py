"""Functions in C that XLA calls on CPUs: compiled once for this machine, kept beside compiled programs.

Whoever uses one has the same function in JAX for where there is no compiler, and a test that both agree.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import jax

from edqn_jax.parallel.programs import private_folder

SWITCH = "EDQN_JAX_NATIVE"
"""Environment variable; with 0 nothing in C is used."""

HEADER = Path(__file__).with_name("handler.h")

FLAGS = (
    *("-std=gnu11", "-O3", "-march=native", "-fPIC", "-shared"),
    # What vector instructions need. Comparisons of NaN are never relied on.
    *("-fno-math-errno", "-fno-trapping-math", "-ffinite-math-only", "-fno-signed-zeros"),
)


@functools.cache
def registered(source: Path, targets: tuple[str, ...], definitions: tuple[str, ...] = ()) -> bool:
    """Compiles and loads a source, and registers its handlers with XLA; returns whether that was possible.

    Args:
        source: C, with XLA's header for foreign functions.
        targets: names of its handlers.
        definitions: of the preprocessor, NAME=VALUE.
    """
    compiler = shutil.which(os.environ.get("CC", "cc"))
    if compiler is None or os.environ.get(SWITCH, "1") == "0":
        return False
    try:
        with contextlib.ExitStack() as scratch:
            # Where nothing can be kept, the file is not needed once it is loaded.
            folder = private_folder() or Path(scratch.enter_context(tempfile.TemporaryDirectory()))
            library = _loaded(compiler, source, definitions, folder)
        for target in targets:
            jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(getattr(library, target)), platform="cpu")
    except (OSError, subprocess.SubprocessError, jax.errors.JaxRuntimeError):
        return False
    return True


def _loaded(compiler: str, source: Path, definitions: tuple[str, ...], folder: Path) -> ctypes.CDLL:
    """Returns the library, compiled in `folder` unless one of the same source, flags and XLA is kept there."""
    defined = [f"-D{definition}" for definition in definitions]
    headers = [f"-I{folder}" for folder in (jax.ffi.include_dir(), HEADER.parent)]
    command = [compiler, *FLAGS, *defined, *headers, str(source), "-lm"]
    told_apart = (command, source.read_bytes(), HEADER.read_bytes(), jax.__version__)
    library = folder / f"{source.stem}-{hashlib.sha256(repr(told_apart).encode()).hexdigest()[:16]}.so"
    if not library.is_file():
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            made = Path(scratch) / library.name
            subprocess.run([*command, "-o", str(made)], check=True, capture_output=True, timeout=60)
            made.replace(library)
    return ctypes.CDLL(str(library))
