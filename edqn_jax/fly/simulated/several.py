"""Missions in several processes at once, each with its vehicle and its autopilot on a core of its own."""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

import jax

from edqn_jax.config import Config
from edqn_jax.fly.simulated.missions import Mission, Setup, environment_of, fly_mission

_shared: list[Any] = []
"""In a process of its own: what makes the missions' environment, and their setup."""


def fly_at_once(world: str, config: Config, missions: int, seed: int, setup: Setup, *, jobs: int) -> Iterator[Mission]:
    """Yields how each mission ended, in the order in which they end.

    They end as in one process: each has a simulated clock, ports and a random stream of its own.

    Args:
        world: as in `environment_of`, with the next three.
        config: the policy's.
        missions: how many.
        seed: of the test worlds.
        setup: what they share.
        jobs: how many processes.

    Raises:
        ConfigError: as `environment_of` and `fly_mission`.
        MissingPackageError: as `fly_mission`.
    """
    fresh = multiprocessing.get_context("spawn")  # because JAX's threads do not survive a fork
    cores = fresh.SimpleQueue()
    for number in range(jobs):
        cores.put(number)
    with ProcessPoolExecutor(
        min(jobs, missions), fresh, initializer=_prepare, initargs=(cores, world, config, missions, seed, setup)
    ) as pool:
        flown = [pool.submit(_fly, number) for number in range(missions)]
        try:
            for each in as_completed(flown):
                yield each.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _prepare(cores: Any, world: str, config: Config, missions: int, seed: int, setup: Setup) -> None:
    # Of a mission's processes one alone works at a time; on one core they hand over without waking another.
    with contextlib.suppress(AttributeError):  # not every system can
        own = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {own[cores.get() % len(own)]})
    jax.config.update("jax_platforms", "cpu")  # an accelerator's memory is not theirs to share
    _shared[:] = functools.cache(functools.partial(environment_of, world, config, missions, seed)), setup


def _fly(number: int) -> Mission:
    environment, setup = _shared  # made with the first mission, so that its errors are a mission's
    return fly_mission(environment(), number, setup)
