"""Decision latency: the time from an observation to an action."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import Config
from edqn_jax.learn import policy
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.sim import env
from edqn_jax.sim.sensor import sensor_of


def decision_latency_ms(config: Config, params: PolicyParams, calls: int = 300) -> dict[str, float]:
    """Returns the median and 99th percentile of `decision_seconds`, in milliseconds: `median`, `p99`."""
    median, p99 = np.percentile(1e3 * decision_seconds(config, params, calls), [50, 99])
    return {"median": float(median), "p99": float(p99)}


def decision_seconds(config: Config, params: PolicyParams, calls: int) -> np.ndarray:
    """Returns the seconds [calls] that each of `calls` decisions takes, from arrays on the host to an action there."""
    seen = env.Observation(
        sensed=sensor_of(config).example(config), own=jnp.zeros(env.OWN_SIZE), motion=jnp.zeros(env.MOTION_SIZE)
    )
    seen, memory = jax.tree.map(np.asarray, (seen, policy.empty_memory(config)))  # on the host
    act = jax.jit(lambda params, memory, seen, key: policy.act(config, params, memory, seen, key))
    params, key = jax.device_put(params), jax.random.key(0)
    seconds = []
    for _ in range(calls + 1):
        began = time.perf_counter()
        int(act(params, memory, seen, key)[0])
        seconds.append(time.perf_counter() - began)
    return np.array(seconds[1:])  # the first call compiled
