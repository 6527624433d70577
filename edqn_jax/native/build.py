"""Functions in C that XLA calls, on CPUs or GPUs: those that a wheel brings, or compiled once for this machine and
kept beside compiled programs.

Whoever uses one has the same function in JAX for where there is no compiler, and a test that both agree.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import hashlib
import logging
import shlex
import subprocess
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax

from edqn_jax.devices.cache import private_folder
from edqn_jax.native import shipped

_loading: dict[Path, threading.Lock] = {}
"""By source: each is compiled once, several at a time, and who needs a small one does not wait for a large one."""

_registering = threading.Lock()  # JAX makes a capsule with types that it sets on what all threads share

_SHIPPED_SOURCES = tuple(Path(__file__).parents[1] / source for source in shipped.SOURCES)

HEADERS = tuple(Path(__file__).with_name(f"{name}.h") for name in ("handler", "kernel"))


@dataclasses.dataclass(frozen=True)
class Compiler:
    """What compiles a source, and for which of XLA's platforms."""

    variable: str  # environment variable that names another one, with its own options
    usual: str
    flags: tuple[str, ...]
    platform: str
    told: int  # line of what it says of its version that names it


C = Compiler(
    shipped.NAMED,
    shipped.USUAL,
    (*shipped.FLAGS, "-march=native"),
    "cpu",
    0,
)


@dataclasses.dataclass(frozen=True)
class Library:
    """What `ensure_registered` was asked for."""

    source: Path
    targets: tuple[str, ...]
    definitions: tuple[str, ...]
    by: Compiler
    headers: tuple[Path, ...]


_USED: dict[Library, None] = {}  # in the order in which they were registered


def used_libraries() -> list[Library]:
    """Returns the libraries that this process has registered with XLA."""
    return list(_USED)


@functools.cache
def cuda_compiler() -> Compiler | None:
    """Returns the compiler for NVIDIA GPUs like the first of this process; None where there is none."""
    try:
        major, minor = str(jax.local_devices(backend="cuda")[0].compute_capability).split(".")
    except RuntimeError:
        return None
    # Quotients and roots to 2 units in the last place, and no numbers below 1e-38.
    fast = ("-prec-div=false", "-prec-sqrt=false", "-ftz=true")
    flags = ("-O3", f"-arch=sm_{major}{minor}", *fast, "-Xcompiler=-fPIC", "-shared")
    return Compiler("NVCC", "nvcc", flags, "CUDA", -1)


@functools.cache
def compiler_version(of: Compiler | None = C) -> str | None:
    """Returns the name and version of a compiler in its own words; None where it is not used.

    Of a library that the package brings, also the kind of processor that it was compiled for.
    """
    if of is C and (found := shipped.shipped_library()) is not None:
        return f"{shipped.shipped_compiler()}, for {found[0]} in the wheel"
    command = None if of is None else _command(of)
    if of is None or command is None:
        return None
    lines = _version(command).splitlines()
    return lines[of.told] if lines else shlex.join(command)


def _version(command: Sequence[str]) -> str:
    """Returns what a compiler says of its version; nothing where it does not answer."""
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        said = subprocess.run([*command, "--version"], capture_output=True, timeout=20)
        if said.returncode == 0:
            return said.stdout.decode(errors="replace").strip()
    return ""


def _command(of: Compiler) -> list[str] | None:
    """Returns the compiler that is named, else the usual one, with its options; None if none is to be used."""
    return None if shipped.is_switched_off() else shipped.find_compiler(of.variable, of.usual)


def ensure_registered(
    source: Path,
    targets: tuple[str, ...],
    definitions: tuple[str, ...] = (),
    by: Compiler = C,
    headers: tuple[Path, ...] = (),
) -> bool:
    """Loads a source's library and registers its handlers with XLA; returns whether that was possible.

    It is the one that the package brings; where there is none, or CC names a compiler, it is compiled here. Where that
    was not possible, a warning says why. A source NAME.c may export `edqn_unusable_NAME`, which returns why it cannot
    be used on this machine, or a null pointer.

    Args:
        source: C, with XLA's header for foreign functions.
        targets: names of its handlers.
        definitions: of the preprocessor, NAME=VALUE.
        by: compiler.
        headers: that the source includes from beside it.
    """
    with _loading.setdefault(source, threading.Lock()):
        found = _registered(source, targets, definitions, by, headers)
        if found:
            _USED[Library(source, targets, definitions, by, headers)] = None
        return found


def ensure_for(platform: str, sources: Mapping[str, Path], targets: tuple[str, ...], headers: tuple[Path, ...]) -> bool:
    """Does `ensure_registered` for "cpu" with `sources["c"]`, and for "cuda" with `sources["cu"]`."""
    by, source = (C, sources["c"]) if platform == "cpu" else (cuda_compiler(), sources["cu"])
    return by is not None and ensure_registered(source, targets, by=by, headers=headers)


@functools.cache
def _registered(
    source: Path, targets: tuple[str, ...], definitions: tuple[str, ...], by: Compiler, headers: tuple[Path, ...]
) -> bool:
    brought = shipped.shipped_library() if by is C and source in _SHIPPED_SOURCES and not definitions else None
    if brought is not None and _register(lambda: ctypes.CDLL(str(brought[1])), source, targets, by):
        return True
    command = _command(by)
    return command is not None and _register(
        lambda: _compiled(command, source, definitions, by, headers), source, targets, by
    )


def _compiled(
    command: list[str], source: Path, definitions: tuple[str, ...], by: Compiler, headers: tuple[Path, ...]
) -> ctypes.CDLL:
    """Returns the library, from where such files are kept or compiled now."""
    with contextlib.ExitStack() as scratch:
        # Where nothing can be kept, the file is not needed once it is loaded.
        folder = private_folder() or Path(scratch.enter_context(tempfile.TemporaryDirectory()))
        return _load_library(command, by.flags, source, definitions, folder, headers)


def _register(load: Callable[[], ctypes.CDLL], source: Path, targets: tuple[str, ...], by: Compiler) -> bool:
    """Loads a library and registers its handlers with XLA; returns whether that was possible, and warns if not."""
    try:
        library = load()
        _check_usable(library, source)
        with _registering:
            for target in targets:
                handler = jax.ffi.pycapsule(getattr(library, target))
                jax.ffi.register_ffi_target(target, handler, platform=by.platform)
    except (OSError, AttributeError, subprocess.SubprocessError, jax.errors.JaxRuntimeError) as error:
        said = error.stderr.decode(errors="replace") if isinstance(error, subprocess.CalledProcessError) else str(error)
        first = next(iter(said.strip().splitlines()), type(error).__name__)
        logging.getLogger(__name__).warning(
            "%s could not be compiled or loaded, JAX does its work more slowly: %s", source.name, first
        )
        return False
    return True


def _check_usable(library: ctypes.CDLL, source: Path) -> None:
    """Asks a library whether what it has of a source can be used here.

    Raises:
        OSError: with its answer, if it cannot.
    """
    ask = getattr(library, f"edqn_unusable_{source.stem}", None)
    if ask is not None:
        ask.restype = ctypes.c_char_p
        reason = ask()
        if reason is not None:
            raise OSError(reason.decode(errors="replace"))


def _load_library(
    compiler: list[str],
    flags: tuple[str, ...],
    source: Path,
    definitions: tuple[str, ...],
    folder: Path,
    headers: tuple[Path, ...] = (),
) -> ctypes.CDLL:
    """Returns the library, compiled in `folder` unless one of the same source, compiler and XLA is kept there."""
    defined = [f"-D{definition}" for definition in definitions]
    searched = [f"-I{folder}" for folder in (jax.ffi.include_dir(), HEADERS[0].parent)]
    command = [*compiler, *flags, *defined, *searched, str(source), "-lm"]
    texts = [file.read_bytes() for file in (source, *HEADERS, *headers)]
    told_apart = (command, _version(compiler), texts, jax.__version__)
    library = folder / f"{source.stem}-{hashlib.sha256(repr(told_apart).encode()).hexdigest()[:16]}.so"
    if library.is_file():
        with contextlib.suppress(OSError):  # a damaged file is made anew
            return ctypes.CDLL(str(library))
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        made = Path(scratch) / library.name
        subprocess.run([*command, "-o", str(made)], check=True, capture_output=True, timeout=300)
        made.replace(library)
    return ctypes.CDLL(str(library))
