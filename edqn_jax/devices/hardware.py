"""What a machine has, without starting JAX: processes must be joined, and devices counted, before that."""

from __future__ import annotations

import os
import pkgutil
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

HIDDEN = ("", "-1", "none", "nodevfiles")
"""Values of CUDA_VISIBLE_DEVICES that hide every GPU."""


CARDS = {"jax_cuda": ("nvidia[0-9]*", "dxg"), "jax_rocm": ("kfd",)}
"""Device files of the cards that each of JAX's plugins drives, by the beginning of its name."""


def detect_hardware(environ: Mapping[str, str] = os.environ, devices: Path = Path("/dev")) -> Literal["cpu", "gpu"]:
    """Returns `gpu` where there is a GPU, JAX's plugin for it is installed, and the environment does not hide it.

    Args:
        environ: environment variables; JAX_PLATFORMS and CUDA_VISIBLE_DEVICES are read.
        devices: folder of device files.
    """
    first = environ.get("JAX_PLATFORMS", "").lower().split(",")[0].strip()
    if first and first not in ("cuda", "gpu", "rocm"):
        return "cpu"
    if environ.get("CUDA_VISIBLE_DEVICES", "all").strip().lower() in HIDDEN:
        return "cpu"
    for plugin, patterns in CARDS.items():
        if any(next(devices.glob(pattern), None) for pattern in patterns) and _has_plugin(plugin):
            return "gpu"
    return "cpu"


def _has_plugin(plugin: str) -> bool:
    names = [module.name for module in pkgutil.iter_modules()]
    return any(name.startswith(plugin) and name.endswith("_plugin") for name in names)


def count_cores() -> int:
    """Returns the number of cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def describe_processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Returns the CPU's model name, on x86 family, model and stepping, and the number of cores of this process.

    Virtual machines often name processors of several generations alike, so the numbers tell them apart.
    """
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.is_file() else []
    first: dict[str, str] = {}
    for name, _, value in (line.partition(":") for line in lines):
        first.setdefault(name.strip(), value.strip())
    keys = {"cpu family": "family", "model": "model", "stepping": "stepping"}
    said = ", ".join(f"{name} {first[key]}" for key, name in keys.items() if key in first)
    named = first.get("model name", platform.machine()) + (f" ({said})" if said else "")
    return f"{named}, {count_cores()} cores"
