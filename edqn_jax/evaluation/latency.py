"""Latency of one decision."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import Config
from edqn_jax.learn import policy
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.sim import env
from edqn_jax.sim.events import EventField, divides_window
from edqn_jax.sim.moves import DIRECTIONS
from edqn_jax.sim.sensor import Sensed


def decision_latency_ms(config: Config, params: PolicyParams, calls: int = 300) -> dict[str, float]:
    """Returns the median and 99th percentile latency of a decision, from host arrays to an action on the host, ms."""
    median, p99 = np.percentile(1e3 * decision_seconds(config, params, calls), [50, 99])
    return {"median": float(median), "p99": float(p99)}


def decision_seconds(config: Config, params: PolicyParams, calls: int) -> np.ndarray:
    """Returns the latency [calls] of each of `calls` decisions, from host arrays to an action on the host, seconds."""
    seen = env.Observation(sensed=_anything(config), own=jnp.zeros(env.OWN_SIZE))
    seen, memory = jax.tree.map(np.asarray, (seen, policy.empty_memory(config)))  # on the host
    act = jax.jit(lambda params, memory, seen, key: policy.act(config, params, memory, seen, key))
    params, key = jax.device_put(params), jax.random.key(0)
    seconds = []
    for _ in range(calls + 1):
        began = time.perf_counter()
        int(act(params, memory, seen, key)[0])
        seconds.append(time.perf_counter() - began)
    return np.array(seconds[1:])  # the first call compiles


def _anything(config: Config) -> Sensed:
    """Something that the sensor might show."""
    rng, height, width = np.random.default_rng(0), config.camera.height, config.camera.width
    if config.env.sensor in ("frames", "depth"):
        return jnp.asarray(rng.random((height, width), np.float32))
    if config.env.sensor == "ranges":
        return jnp.asarray(rng.random(len(DIRECTIONS), np.float32))
    if config.env.sensor == "blind":
        return None
    pixels = (max(len(config.events.frame_times_s) - 1, 1), height, width)
    count, times = jnp.asarray(rng.integers(0, 3, pixels), jnp.int32), jnp.zeros(pixels)
    window = config.events.frame_times_s[-1] - config.events.frame_times_s[0]
    even = divides_window(config.events, len(config.events.frame_times_s))
    return EventField(count, jnp.sign(count).astype(jnp.int8), times, times, window, even)
