"""Decision latency: the time from an observation, or from the light that makes it, to an action."""

from __future__ import annotations

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import Config
from edqn_jax.learn import policy
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.sim import env
from edqn_jax.sim.drone import Flight
from edqn_jax.sim.scene import Scene
from edqn_jax.sim.sensor import SensorMemory, at_rest, frame_steps, sense, sensor_of


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
    act = jax.jit(lambda params, memory, seen, key: policy.act(config, params, memory, seen, key)[0])
    params, key = jax.device_put(params), jax.random.key(0)
    return _timed(lambda: int(act(params, memory, seen, key)), calls)


def look_seconds(config: Config, params: PolicyParams, scene: Scene, calls: int) -> np.ndarray:
    """Returns the seconds [calls] from poses on the host to an action there: pictures, events, code and Q-network.

    Args:
        scene: what the camera sees, level, from the world's own start, in a flight ahead.
    """
    steps = len(frame_steps(config))
    place = np.asarray(scene.start) + np.linspace(-0.3, 0.0, steps)[:, None] * np.array([1.0, 0.0, 0.0])
    poses = Flight(
        position=jnp.asarray(place, jnp.float32),
        quaternion=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (steps, 1)),
        velocity=jnp.tile(jnp.array([4.0, 0.0, 0.0]), (steps, 1)),
    )
    before = at_rest(config, jax.random.key(0))
    poses, before, memory = jax.tree.map(np.asarray, (poses, before, policy.empty_memory(config)))  # on the host

    @jax.jit
    def act(
        params: PolicyParams, scene: Scene, poses: Flight, before: SensorMemory, memory: Array, key: Array
    ) -> Array:
        sensed, _ = sense(config, scene, poses, before, key)
        seen = env.Observation(sensed=sensed, own=jnp.zeros(env.OWN_SIZE), motion=jnp.zeros(env.MOTION_SIZE))
        return policy.act(config, params, memory, seen, key)[0]

    params, scene, key = jax.device_put(params), jax.device_put(scene), jax.random.key(0)
    return _timed(lambda: int(act(params, scene, poses, before, memory, key)), calls)


def _timed(work: Callable[[], object], calls: int) -> np.ndarray:
    """Returns the seconds [calls] of each call, without a first one that compiles."""
    seconds = []
    for _ in range(calls + 1):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return np.array(seconds[1:])
