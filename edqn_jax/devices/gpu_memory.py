"""Free memory of NVIDIA's GPUs before JAX takes its share: a program that gets less may be aborted by XLA later."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import subprocess
from collections.abc import Mapping

from edqn_jax.errors import ConfigError

SHARES = ("XLA_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_MEM_FRACTION")
"""Environment variables for the share of GPU memory that JAX preallocates."""

SHARE = 0.75
"""Share that JAX preallocates by default."""

LEAST = 0.05
"""A share that is worth a try."""

_GIB_OF_MIB = 1 / 1024
_QUERY = ("--query-gpu=name,memory.total,memory.free", "--format=csv,noheader,nounits")
_PLUGINS = ("jax_cuda12_plugin", "jax_cuda13_plugin")


def check_gpus_are_free(environ: Mapping[str, str] = os.environ) -> None:
    """Raises if the GPU memory that JAX preallocates is not free; must be called before JAX is first used.

    Does nothing where JAX uses no NVIDIA GPU, where it takes memory as it needs it, and where `nvidia-smi` is missing
    or does not answer.

    Args:
        environ: environment variables.

    Raises:
        ConfigError: says how much is free, and what makes it enough.
    """
    if not _uses_cuda(environ):
        return
    share = share_taken(environ)
    variable = next((name for name in SHARES if name in environ), SHARES[0])  # JAX refuses both at once
    for name, whole, free in _gpus(environ):
        if share is not None and free < share * whole:
            left = int(100 * free / whole) / 100
            remedy = f", or give each program its share, here at most {variable}={left:.2f}" if left >= LEAST else ""
            raise ConfigError(
                f"the {name} has {free * _GIB_OF_MIB:.1f} GiB of memory free, but JAX takes {share:.0%} of all, "
                f"{share * whole * _GIB_OF_MIB:.1f} GiB, when it starts; end what else uses it{remedy}"
            )


def share_taken(environ: Mapping[str, str]) -> float | None:
    """Returns the share of GPU memory that JAX preallocates; None if preallocation is off."""
    preallocates = environ.get("XLA_PYTHON_CLIENT_PREALLOCATE", "").strip().lower() not in ("false", "0")
    if not preallocates or environ.get("XLA_PYTHON_CLIENT_ALLOCATOR", "").strip().lower() == "platform":
        return None
    for name in SHARES:
        with contextlib.suppress(KeyError, ValueError):
            return float(environ[name])
    return SHARE


def _uses_cuda(environ: Mapping[str, str]) -> bool:
    """Returns whether JAX would look for NVIDIA's GPUs."""
    wanted = [name.strip().lower() for name in environ.get("JAX_PLATFORMS", "").split(",") if name.strip()]
    asked = not wanted or "cuda" in wanted or "gpu" in wanted
    return asked and any(importlib.util.find_spec(name) is not None for name in _PLUGINS)


def _gpus(environ: Mapping[str, str]) -> list[tuple[str, int, int]]:
    """Returns name, MiB in all and MiB free of each GPU that this process may use; empty if unknown."""
    program, visible = shutil.which("nvidia-smi", path=environ.get("PATH")), environ.get("CUDA_VISIBLE_DEVICES")
    if program is None or visible == "":
        return []
    chosen = [] if visible is None else ["-i", visible]
    found = []
    with contextlib.suppress(OSError, ValueError, subprocess.SubprocessError):
        said = subprocess.run([program, *chosen, *_QUERY], capture_output=True, text=True, timeout=10, check=True)
        for line in said.stdout.splitlines():
            name, whole, free = (part.strip() for part in line.rsplit(",", 2))
            found.append((name, int(whole), int(free)))
    return found
