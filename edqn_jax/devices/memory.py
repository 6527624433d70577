"""Memory of devices: whether a train state fits, and what to say where memory is full."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from edqn_jax.errors import ConfigError

GIB = 2**30

LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
"""Files in which Linux says how much memory a container may use."""

REMEDIES = {
    "train": "a smaller --num-envs, --agent.replay-size or --encoder.replay-size, or fewer --seeds, needs less",
    "evaluate": "fewer --missions need less",
    "export": "fewer --checks need less",
}
"""What to do, by command."""

REMEDY = "end what else uses it"

_ASKED = re.compile(r"(?:allocat\w*|needs?)\D{0,40}?(\d+(?:\.\d+)?)\s*(bytes|B|[KMGT]i?B)\b", re.IGNORECASE)
_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}


def bytes_of(shapes: Any) -> int:
    """Returns the bytes of arrays, or of what has their shapes and types, such as `jax.eval_shape` returns."""
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))


def memory_of(device: Any) -> tuple[int, int] | None:
    """Returns the bytes of a device's memory, and how many of them are free; of a CPU, all that the process may use.

    None if unknown.
    """
    with contextlib.suppress(jax.errors.JaxRuntimeError, NotImplementedError):
        said: Mapping[str, int] = device.memory_stats() or {}
        if "bytes_limit" in said:
            return said["bytes_limit"], said["bytes_limit"] - said.get("bytes_in_use", 0)
    host = host_bytes() if device.platform == "cpu" else None
    return None if host is None else (host, host)


def host_bytes(limits: Sequence[Path] = LIMITS) -> int | None:
    """Returns the memory of this machine, or the part that this process may use; None if unknown."""
    found = []
    with contextlib.suppress(AttributeError, ValueError, OSError):  # not on every system
        found.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for file in limits:
        with contextlib.suppress(OSError, ValueError):  # such as `max`
            found.append(int(file.read_text(encoding="utf-8")))
    return min(found, default=None)


def check_fits(state: Any, devices: Sequence[Any]) -> None:
    """Raises if a train state is larger than the free memory of the device that makes it, before it is cut.

    Temporaries need more, so a state that passes may still be too large.

    Args:
        state: arrays, or their shapes and types.
        devices: of this process.

    Raises:
        ConfigError: says how much is needed, how much there is, and what needs less.
    """
    needed = bytes_of(state)
    for device in devices:
        memory = memory_of(device)
        if memory is not None and needed > memory[1]:
            whole, free = (f"{count / GIB:.2f} GiB" for count in memory)
            has = whole if free == whole else f"{free} free of {whole}"
            raise ConfigError(
                f"the train state takes {needed / GIB:.2f} GiB of memory, but {_named(device)} has {has}; "
                f"{REMEDIES['train']}"
            )


def memory_error(error: BaseException, command: str) -> ConfigError | None:
    """Returns what to say of an error if it is that memory was full, of a device or of the host; else None.

    Args:
        error: of JAX, NumPy or Python.
        command: that met it.
    """
    text = str(error)
    if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in text:
        return None
    asked = _ASKED.search(text)
    said = ""
    if asked is not None:
        unit = "" if asked[2].lower() in ("b", "bytes") else asked[2][0].lower()
        said = f": {float(asked[1]) * _UNITS[unit] / GIB:.2f} GiB more were asked for"
    where, has = "this machine", host_bytes()
    if not isinstance(error, MemoryError):
        with contextlib.suppress(RuntimeError):
            device = jax.local_devices()[0]
            where, has = _named(device), (memory_of(device) or (None,))[0]
    if has is not None:
        said += f"{' and' if said else ':'} it has {has / GIB:.2f} GiB"
    return ConfigError(f"the memory of {where} is full{said}; {REMEDIES.get(command, REMEDY)}")


def _named(device: Any) -> str:
    return "this machine" if device.platform == "cpu" else f"the {device.device_kind}"
