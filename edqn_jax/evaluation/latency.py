"""Decision latency: the time from an observation to an action."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from edqn_jax.config import Config
from edqn_jax.learn.actor import Actor, AgentActor, blank_observation


def decision_latency_ms(
    config: Config, params: Any, calls: int = 300, *, actor: Actor | None = None
) -> dict[str, float]:
    """Returns the median and 99th percentile of `decision_seconds`, in milliseconds: `median`, `p99`."""
    median, p99 = np.percentile(1e3 * decision_seconds(config, params, calls, actor=actor), [50, 99])
    return {"median": float(median), "p99": float(p99)}


def decision_seconds(config: Config, params: Any, calls: int, *, actor: Actor | None = None) -> np.ndarray:
    """Returns the seconds [calls] that each of `calls` decisions takes, from arrays on the host to an action there."""
    return time_interleaved([decision_call(config, params, actor)], calls)[0]


def decision_call(config: Config, params: Any, actor: Actor | None = None) -> Callable[[], np.ndarray]:
    """Returns a callable that runs one decision, from host arrays to an action [] or [...] on the host.

    Args:
        config: of the policy.
        params: of the actor.
        actor: what decides; None is the agent of `config`.
    """
    actor = actor or AgentActor(config)
    seen, memory = jax.tree.map(np.asarray, (blank_observation(config), actor.init()))  # on the host
    act = jax.jit(lambda params, memory, seen, key: actor.act(params, memory, seen, key)[0])
    params, key = jax.device_put(params), jax.random.key(0)
    return lambda: np.asarray(act(params, memory, seen, key))


def time_interleaved(works: Sequence[Callable[[], object]], calls: int, block: int = 1) -> np.ndarray:
    """Returns the seconds [works, calls] of each call, after a first one of each that compiles.

    `block` calls of each follow one another before the next one's turn, so that all of them meet the same machine.
    """
    for work in works:
        work()
    seconds = np.empty((len(works), calls))
    for begun in range(0, calls, block):
        for number, work in enumerate(works):
            for call in range(begun, min(begun + block, calls)):
                began = time.perf_counter()
                work()
                seconds[number, call] = time.perf_counter() - began
    return seconds
