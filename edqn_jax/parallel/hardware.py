"""What a machine has, without starting JAX: processes must be joined, and devices counted, before that."""

from __future__ import annotations

import os
import pkgutil
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

HIDDEN = ("", "-1", "none", "nodevfiles")
"""Values of CUDA_VISIBLE_DEVICES that hide every GPU."""


def hardware(environ: Mapping[str, str] = os.environ, devices: Path = Path("/dev")) -> Literal["cpu", "gpu"]:
    """Returns `gpu` where there is a GPU, JAX's plugin for it is installed, and the environment does not hide it.

    Args:
        environ: environment variables; JAX_PLATFORMS and CUDA_VISIBLE_DEVICES are read.
        devices: folder of device files.
    """
    platforms = environ.get("JAX_PLATFORMS", "").lower()
    if platforms and not any(name in platforms for name in ("cuda", "gpu", "rocm")):
        return "cpu"
    if environ.get("CUDA_VISIBLE_DEVICES", "all").lower() in HIDDEN:
        return "cpu"
    cards = [*devices.glob("nvidia[0-9]*"), *devices.glob("kfd"), *devices.glob("dxg")]
    return "gpu" if cards and _has_plugin() else "cpu"


def _has_plugin() -> bool:
    names = [module.name for module in pkgutil.iter_modules()]
    return any(name.startswith(("jax_cuda", "jax_rocm")) and name.endswith("_plugin") for name in names)
