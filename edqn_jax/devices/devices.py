"""Devices: how many JAX presents, how many a run uses, compiler options."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Sequence

import jax

from edqn_jax.devices.hardware import count_cores
from edqn_jax.devices.sums import check_sums
from edqn_jax.errors import ConfigError
from edqn_jax.xla_flags import YNN_OPTION, read_flags

DETERMINISTIC_ROUNDING_FLAG = "--xla_backend_extra_options=xla_cpu_disable_loop_unrolling"
"""XLA flag that makes CPU programs round equally for every batch size (docs/decisions/0006)."""


def use_cpu_devices(count: int | None = None) -> None:
    """Makes JAX present the CPU as `count` devices; must be called before JAX is first used.

    None means one per core. Accelerators are found and preferred as before. Also adds `DETERMINISTIC_ROUNDING_FLAG` to
    `XLA_FLAGS`, so that flights are equal on any number of devices, unless `XLA_FLAGS` already holds extra backend
    options.

    Raises:
        RuntimeError: if JAX has already been used.
    """
    jax.config.update("jax_num_cpu_devices", count_cores() if count is None else count)
    flags = read_flags()
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {DETERMINISTIC_ROUNDING_FLAG}".strip()
    if jax.__version_info__[:2] == (0, 11):
        # Its new partitioner crashes where `shard_map` and a loop handle arrays without elements, as of a scene
        # without capsules. The old one does not.
        jax.config.update("jax_use_shardy_partitioner", False)


@functools.cache
def compiler_options(platform: str) -> dict[str, str | bool]:
    """Returns the compiler options for a platform beyond XLA's defaults, for `jax.jit` and `compile`.

    XLA's path for sums and products through YNNPACK is off, since it computes some sums wrongly, as the flag does that
    is set at import (docs/decisions/0028). LLVM's first optimisation level gives programs as fast as its third and
    compiles an eighth faster; where XLA_FLAGS names a level, that one is taken.

    Raises:
        ConfigError: if programs with these options get wrong sums on this machine.
    """
    if platform != "cpu":
        return {}
    wanted = {YNN_OPTION: ""}
    if "xla_backend_optimization_level" not in read_flags():
        wanted["xla_backend_optimization_level"] = "1"
    options: dict[str, str | bool] = {name: value for name, value in wanted.items() if _has_option(name, value)}
    check_sums(options)
    return options


@functools.cache
def quick_compiler_options(platform: str) -> dict[str, str | bool]:
    """Returns the compiler options for a program that runs a few times only, so that compiling it takes longest.

    XLA's older code for fused operations on CPUs takes two thirds of the time to compile. It runs half as fast again,
    and rounds differently.
    """
    older: dict[str, str | bool] = {"xla_cpu_use_fusion_emitters": False}
    known = platform == "cpu" and all(_has_option(name, value) for name, value in older.items())
    return compiler_options(platform) | (older if known else {})


def _has_option(name: str, value: str | bool) -> bool:
    """Returns whether the installed XLA knows the option."""
    try:
        jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
    except (jax.errors.JaxRuntimeError, ValueError):
        return False
    return True


def choose_devices(requested: int, shards: int) -> list[jax.Device]:  # pyright: ignore[reportInvalidTypeForm]
    """Returns the devices that a run uses, of all processes; JAX's default kind, so GPUs where there are any.

    Args:
        requested: how many; 0 uses the largest number that divides the shards.
        shards: logical shards of environments and replay.

    Returns:
        the devices, those of process 0 first; equally many of each process.

    Raises:
        ConfigError: if there are fewer than requested, or their number does not divide the shards, or is no
            multiple of the number of processes.
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
            f"train.devices must be at most {len(found)}, the number of {kind} devices found, not {requested}"
        )
    if shards % requested:
        raise ConfigError(f"train.devices must be a divisor of train.shards ({shards}), not {requested}")
    if requested % processes:
        raise ConfigError(f"train.devices must be a multiple of the {processes} processes, not {requested}")
    each = requested // processes
    return [d for process in range(processes) for d in jax.local_devices(process)[:each]]


def most_that_divide(shards: int, available: int) -> int:
    """Returns the largest divisor of `shards` that is at most `available`."""
    return max(count for count in range(1, available + 1) if shards % count == 0)


def describe_idle_cores(shards: int, batches: Sequence[int], cores: int) -> str:
    """Returns a sentence that says how more cores are used than a run with these shards uses; empty if none can be.

    Args:
        shards: logical shards of environments and replay.
        batches: what shards must divide, such as the number of environments.
        cores: how many there are.
    """
    used, most = most_that_divide(shards, cores), most_that_divide(math.gcd(*batches), cores)
    if most <= used:
        return ""
    return f"Training uses {used} of {cores} cores; with --train.shards {most} it uses {most}, and other random numbers"
