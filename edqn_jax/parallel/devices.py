"""How many devices there are, and how many of them a run uses."""

from __future__ import annotations

import functools
import os
import platform
from pathlib import Path

import jax

from edqn_jax.errors import ConfigError

ALIKE = "--xla_backend_extra_options=xla_cpu_disable_loop_unrolling"
"""XLA's flag under which programs for CPUs round alike whatever the size of a batch (docs/decisions/0006)."""


def use_cpu_devices(count: int | None = None) -> None:
    """Lets JAX present the CPU as `count` devices; must be called before JAX is first used.

    `None` means one per core. Has no effect on which accelerators JAX finds, and prefers. Adds to `XLA_FLAGS` what
    makes flights equal on any number of devices, unless extra options stand there already.

    Raises:
        RuntimeError: if JAX has been used already.
    """
    jax.config.update("jax_num_cpu_devices", cores() if count is None else count)
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {ALIKE}".strip()
    if jax.__version_info__[:2] == (0, 11):
        # Its new partitioner crashes on arrays without elements, which a scene without capsules has, where
        # `shard_map` and a loop meet. The old one does not.
        jax.config.update("jax_use_shardy_partitioner", False)


@functools.cache
def compiler_options(platform: str) -> dict[str, str | bool]:
    """What programs of ours are compiled with on a platform, beyond its defaults; for `jax.jit` and `compile`.

    On CPUs XLA hands sums of products to a library that is made for large ones: one sum of 6 x 6 numbers in a
    physics step then takes longer than the rest of the step. Matrix products stay with the library. Of LLVM's
    optimisations the first level gives programs as fast as the third, and an eighth sooner.
    """
    if platform != "cpu":
        return {}
    wanted = {
        "xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_DOT",
        "xla_backend_optimization_level": "1",
    }
    return {name: value for name, value in wanted.items() if _has_option(name, value)}


def _has_option(name: str, value: str) -> bool:
    """Whether this XLA knows it; another need not."""
    try:
        jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
    except (jax.errors.JaxRuntimeError, ValueError):
        return False
    return True


def cores() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processor() -> str:
    """The CPU's model name and how many cores this process may use, for whoever reads a figure."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.is_file() else []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{named[0] if named else platform.machine()}, {cores()} cores"


def choose_devices(requested: int, shards: int) -> list[jax.Device]:  # pyright: ignore[reportInvalidTypeForm]
    """The devices that a run spreads over, of all processes alike; JAX's default kind, so GPUs where there are any.

    Args:
        requested: how many; 0 is as many as divide the shards.
        shards: logical shards of environments and replay.

    Returns:
        the devices, those of process 0 first; every process has equally many of them.

    Raises:
        ConfigError: if there are fewer than requested, or their number does not divide the shards, or the processes
            cannot share them.
    """
    found = jax.devices()
    processes = jax.process_count()
    if shards % processes:
        raise ConfigError(f"train.shards must be a multiple of the {processes} processes, not {shards}")
    if requested == 0:
        requested = processes * most_that_divide(shards // processes, len(found) // processes)
    if requested > len(found):
        kind = found[0].platform.upper()
        raise ConfigError(
            f"train.devices must be at most {len(found)}, the {kind} devices that there are, not {requested}"
        )
    if shards % requested:
        raise ConfigError(f"train.devices must be a divisor of train.shards ({shards}), not {requested}")
    if requested % processes:
        raise ConfigError(f"train.devices must be a multiple of the {processes} processes, not {requested}")
    each = requested // processes
    return [d for process in range(processes) for d in jax.local_devices(process)[:each]]


def most_that_divide(shards: int, available: int) -> int:
    """The largest divisor of `shards` that is at most `available`."""
    return max(count for count in range(1, available + 1) if shards % count == 0)
