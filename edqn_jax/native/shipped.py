"""The library in C that wheels hold, compiled for several kinds of processor when a wheel is built.

`scripts/wheel/hatch_build.py`, which builds it, runs this file by itself, so it imports nothing but Python's own.
"""

from __future__ import annotations

import os
import platform
import shlex
import shutil
from pathlib import Path

SWITCH = "EDQN_JAX_NATIVE"
"""Environment variable; with 0 nothing in C is used."""

NAMED = "CC"
"""Environment variable that names another compiler than `USUAL`, with its own options."""

USUAL = "cc"

FOLDER = Path(__file__).with_name("built")
"""Where a wheel has the library; a checkout has none."""

COMPILER = "compiler.txt"
"""In this folder: name and version of what compiled the library."""

SOURCES = (
    "native/adam.c",
    "native/all_sum.c",
    "learn/perception/patches.c",
    "native/products.c",
    "native/threefry.c",
    "sim/camera/pictures.c",
    "sim/scene/shapes/field_rays.c",
)
"""What is in it, below the package."""

FLAGS = (
    *("-std=gnu11", "-O3", "-fPIC", "-shared"),
    # What vector instructions need. Comparisons of NaN are never relied on.
    *("-fno-math-errno", "-fno-trapping-math", "-ffinite-math-only", "-fno-signed-zeros"),
)
"""Of GCC and Clang, beside the kind of processor."""

_V2 = frozenset({"cx16", "lahf_lm", "popcnt", "pni", "sse4_1", "sse4_2", "ssse3"})
_V3 = _V2 | {"abm", "avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe", "xsave"}
_V4 = _V3 | {"avx512bw", "avx512cd", "avx512dq", "avx512f", "avx512vl"}

KINDS: dict[str, dict[str, frozenset[str]]] = {
    "x86_64": {"x86-64-v4": _V4, "x86-64-v3": _V3, "x86-64-v2": _V2},
    "aarch64": {"armv8-a": frozenset()},
    "arm64": {"armv8-a": frozenset()},
}
"""Kinds of processor that it is compiled for on each machine, the fastest first: the value of -march, and what Linux
says of a processor that can run it."""


def library_of(kind: str) -> str:
    """Returns the name of the library for a kind of processor."""
    return f"edqn-{kind}.so"


def kinds_of_processor(machine: str = platform.machine(), cpuinfo: Path = Path("/proc/cpuinfo")) -> list[str]:
    """Returns the kinds that this processor is of, the fastest first; none for a machine that is not in `KINDS`."""
    return [kind for kind, needs in KINDS.get(machine, {}).items() if needs <= processor_flags(cpuinfo)]


def processor_flags(cpuinfo: Path = Path("/proc/cpuinfo")) -> frozenset[str]:
    """Returns what Linux says that all of this machine's processors can do; nothing on another system."""
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.is_file() else []
    listed = [frozenset(line.partition(":")[2].split()) for line in lines if line.startswith("flags")]
    return frozenset.intersection(*listed) if listed else frozenset()


def find_compiler(named: str = NAMED, usual: str = USUAL) -> list[str] | None:
    """Returns the compiler that a variable names, else the usual one, with its options; None if there is none."""
    given = os.environ.get(named, "")
    try:
        words = shlex.split(given) or [usual]
    except ValueError:  # a quotation without its end, which names no compiler
        words = [given]
    found = shutil.which(words[0])
    return None if found is None else [found, *words[1:]]


def is_switched_off() -> bool:
    """Returns whether nothing in C is to be used."""
    return os.environ.get(SWITCH, "1") == "0"


def shipped_library() -> tuple[str, Path] | None:
    """Returns the fastest library that this package brings for this processor, with its kind.

    None if it brings none, if nothing in C is to be used, or if CC names what is to compile it here.
    """
    if is_switched_off() or os.environ.get(NAMED, ""):
        return None
    held = ((kind, FOLDER / library_of(kind)) for kind in kinds_of_processor())
    return next(((kind, file) for kind, file in held if file.is_file()), None)


def shipped_compiler() -> str:
    """Returns name and version of what compiled the library that this package brings."""
    return (FOLDER / COMPILER).read_text(encoding="utf-8").strip()


def describe_library() -> str:
    """Returns where the library comes from, without loading or compiling it."""
    if is_switched_off():
        return f"not used, {SWITCH}=0"
    library, compiler = shipped_library(), find_compiler()
    if library is not None:
        return f"for {library[0]}, in the package"
    return "none, JAX does its work" if compiler is None else f"compiled here by {compiler[0]}"
