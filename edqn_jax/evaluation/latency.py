"""Decision latency: the time from an observation, or from the light that makes it, to an action."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import Config
from edqn_jax.learn.actor import Actor, AgentActor, PolicyParams, blank_observation
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.sensors.sensor import SensorMemory, at_rest, frame_steps, sense
from edqn_jax.sim.task.observation import MOTION_SIZE, OWN_SIZE, Observation


def decision_latency_ms(
    config: Config, params: Any, calls: int = 300, *, actor: Actor | None = None
) -> dict[str, float]:
    """Returns the median and 99th percentile of `decision_seconds`, in milliseconds: `median`, `p99`."""
    median, p99 = np.percentile(1e3 * decision_seconds(config, params, calls, actor=actor), [50, 99])
    return {"median": float(median), "p99": float(p99)}


def decision_seconds(config: Config, params: Any, calls: int, *, actor: Actor | None = None) -> np.ndarray:
    """Returns the seconds [calls] that each of `calls` decisions takes, from arrays on the host to an action there."""
    return in_turn([decision_call(config, params, actor)], calls)[0]


def decision_call(config: Config, params: Any, actor: Actor | None = None) -> Callable[[], np.ndarray]:
    """Returns what makes one decision, from arrays on the host to an action [] or [...] there.

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


def look_call(config: Config, params: PolicyParams, scene: Scene) -> Callable[[], int]:
    """Returns what leads from poses on the host to an action there: pictures, events, code and Q-network.

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
    before, actor = at_rest(config, jax.random.key(0)), AgentActor(config)
    poses, before, memory = jax.tree.map(np.asarray, (poses, before, actor.init()))  # on the host

    @jax.jit
    def act(
        params: PolicyParams, scene: Scene, poses: Flight, before: SensorMemory, memory: Array, key: Array
    ) -> Array:
        sensed, _ = sense(config, scene, poses, before, key)
        seen = Observation(sensed=sensed, own=jnp.zeros(OWN_SIZE), motion=jnp.zeros(MOTION_SIZE))
        return actor.act(params, memory, seen, key)[0]

    params, scene, key = jax.device_put(params), jax.device_put(scene), jax.random.key(0)
    return lambda: int(act(params, scene, poses, before, memory, key))


def in_turn(works: Sequence[Callable[[], object]], calls: int, block: int = 1) -> np.ndarray:
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
