"""Outcome of an episode, and the physics step at which it ends."""

from __future__ import annotations

import enum

import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.config import Config
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.distance import path_contact
from edqn_jax.sim.scene.scene import Scene, has_motion


class Outcome(enum.IntEnum):
    """Outcome of an episode. All but RUNNING end it; only TIME_OUT is a truncation."""

    RUNNING = 0
    GOAL = 1
    COLLISION = 2
    LEFT_VOLUME = 3
    TIME_OUT = 4
    DIVERGED = 5


def is_terminal(outcome: Array) -> Array:
    """Returns whether outcomes [...] cut the bootstrap, [...] bool: every end but a time-out."""
    return (outcome != Outcome.RUNNING) & (outcome != Outcome.TIME_OUT)


@struct.dataclass
class Verdict:
    """How and when a decision ends. n physics steps."""

    outcome: Array  # [] int32, an `Outcome`
    end_step: Array  # [] int32 in 1..n, physics step of the outcome; n while running
    contact: Array  # [] share of that step flown before a collision touched, 1 otherwise
    hit_drone: Array | None = None  # [] bool, the collision was with a drone; None for a drone alone


def judge_decision(
    config: Config, scene: Scene, goal: Array, before: Array, flight: Flight, decision: Array
) -> tuple[Array, Array, Array]:
    """Returns the outcome of one decision: the earliest physics step wins, and at the same step a collision wins.

    Args:
        scene: shapes that move are where they are at each moment of the decision.
        before: [3] position before the first physics step.
        decision: decisions taken, this one included.

    Returns:
        outcome: [] int32, an `Outcome`.
        end_step: [] int32 in 1..n, physics step of the outcome; n while running.
        contact: [] share of that step flown before a collision touched, 1 otherwise.
    """
    n = flight.position.shape[0]
    path = jnp.concatenate([before[None], flight.position])
    times = ((decision - 1) * n + jnp.arange(n + 1)) * config.drone.physics_dt_s if has_motion(scene) else None
    touch, contact = path_contact(scene, path, config.drone.body_radius_m, times)
    at = flight.position
    apart = at - goal[None]
    arrived = jnp.sum(apart * apart, axis=1) < config.env.goal_radius_m**2
    outside = jnp.any((at < scene.volume[0][None]) | (at > scene.volume[1][None]), axis=1)
    broken = ~jnp.all(jnp.isfinite(at), axis=1)
    # Per physics step, the verdicts in order of precedence.
    verdict = jnp.select(
        [broken, touch, outside, arrived],
        [
            jnp.full(n, int(Outcome.DIVERGED)),
            jnp.full(n, int(Outcome.COLLISION)),
            jnp.full(n, int(Outcome.LEFT_VOLUME)),
            jnp.full(n, int(Outcome.GOAL)),
        ],
        jnp.full(n, int(Outcome.RUNNING)),
    )
    first = jnp.argmax(verdict != Outcome.RUNNING)
    outcome = verdict[first]
    running = outcome == Outcome.RUNNING
    timed_out = running & (decision >= config.env.max_decisions)
    outcome = jnp.where(timed_out, int(Outcome.TIME_OUT), outcome).astype(jnp.int32)
    end_step = jnp.where(running, n, first + 1).astype(jnp.int32)
    return outcome, end_step, jnp.where(outcome == Outcome.COLLISION, contact[first], 1.0)
