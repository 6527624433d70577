"""How shapes move: closed forms of the time of the episode, so that nothing is carried from decision to decision.

N is the capacity of the shapes' kind. Obstacles that move pass through each other and through all others.
"""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.sim.sine import sin_pi


@struct.dataclass
class Motion:
    """How the shapes of one kind move: along a line between walls, on an ellipse, or both. Zeros stand still."""

    velocity: Array  # [N, 3] m/s at time 0; each component changes its sign at the walls
    low: Array  # [N, 3] metres, between which and `high` the centre moves along the axes of its velocity
    high: Array  # [N, 3] metres
    swing: Array  # [N, 2, 3] metres, half axes of the ellipse: along the cosine and along the sine of the phase
    rate: Array  # [N] rad/s
    phase: Array  # [N] rad at time 0


@struct.dataclass
class Throw:
    """Which spheres are balls thrown at where the drone would be, if it flew straight to its goal at a steady pace.

    A ball is absent before its launch, and from when it has flown out of the flight volume.
    """

    share: Array  # [N] of the straight way, at which the ball would meet the drone
    early: Array  # [N] seconds before that at which it is launched; 0 of spheres that are not thrown
    speed: Array  # [N] m/s, without what gravity adds
    bearing: Array  # [N] rad to the left of the straight way, from which it comes
    elevation: Array  # [N] rad over the horizon, from which it comes
    gravity: Array  # [N] m/s^2 downwards
    pace: Array  # [N] m/s, of the drone that it is thrown at


OUTSIDE_M = 1.0
"""Metres beyond the flight volume's faces at which a ball appears and is absent again, plus its radius: no drone is
so near."""


def displacement(motion: Motion, position: Array, time: Array) -> Array:
    """Returns how far the shapes have moved at `time` [] seconds: [N, 3] metres, exactly zero at time 0.

    A velocity is reflected at the walls: the position is a triangle wave of the time. The ellipse is
    a (cos(p + w t) - cos p) + b (sin(p + w t) - sin p).

    Args:
        position: [N, 3] metres at time 0, between the walls where there is a velocity.
    """
    runs = motion.velocity != 0
    both_ways = 2 * jnp.where(runs, motion.high - motion.low, 1.0)
    ahead = position - motion.low + motion.velocity * time
    # XLA's remainder of a division is a call of a library for each number on a CPU, and takes ten times as long.
    ahead = ahead - both_ways * jnp.floor(ahead / both_ways)
    line = jnp.where(runs & (time != 0), motion.low + both_ways / 2 - jnp.abs(ahead - both_ways / 2) - position, 0.0)
    cos, sin = (after - before for after, before in zip(_waves(motion, time), _waves(motion, 0.0), strict=True))
    return line + motion.swing[:, 0] * cos[:, None] + motion.swing[:, 1] * sin[:, None]


def _waves(motion: Motion, time: Array | float) -> tuple[Array, Array]:
    """Returns cosine and sine [N] of the phases at a time."""
    half_turns = (motion.phase + motion.rate * time) / jnp.pi
    return sin_pi(half_turns + 0.5), sin_pi(half_turns)


def top_speed(motion: Motion) -> Array:
    """Returns the largest speed [] m/s of any of the shapes at any time."""
    a, b = motion.swing[:, 0], motion.swing[:, 1]
    aa, bb, ab = (jnp.sum(x * y, axis=1) for x, y in ((a, a), (b, b), (a, b)))
    longest = jnp.sqrt((aa + bb) / 2 + jnp.sqrt(((aa - bb) / 2) ** 2 + ab**2))  # half axis of the ellipse
    line = jnp.sqrt(jnp.sum(motion.velocity**2, axis=1))
    return jnp.max(line + jnp.abs(motion.rate) * longest)


def hit_time(throw: Throw, start: Array, goal: Array) -> Array:
    """Returns when the balls would meet the drone that flies from `start` to `goal` [3], metres: [N] seconds."""
    way = jnp.sqrt(jnp.sum((goal - start) ** 2))
    # Nothing is launched before the episode begins.
    return jnp.maximum(throw.share * way / jnp.maximum(throw.pace, 1e-6), throw.early)


def thrown_to(throw: Throw, start: Array, goal: Array, time: Array) -> Array:
    """Returns where the balls are at `time` [] seconds: [N, 3] metres, whether or not they have been launched.

    Without gravity it is a straight line; with it, the parabola from the same point of launch to the same hit.

    Args:
        start, goal: [3] metres, of the drone that is thrown at.
    """
    way = goal - start
    length = jnp.sqrt(jnp.sum(way**2))
    along = way / jnp.maximum(length, 1e-6)
    hit = hit_time(throw, start, goal)
    aim = start[None] + jnp.minimum(throw.pace * hit, length)[:, None] * along[None]
    heading = jnp.arctan2(way[1], way[0]) + throw.bearing
    level = jnp.cos(throw.elevation)
    comes_from = jnp.stack([level * jnp.cos(heading), level * jnp.sin(heading), jnp.sin(throw.elevation)], axis=1)
    after = time - hit
    fallen = 0.5 * throw.gravity * after * (after + throw.early)
    place = aim - (throw.speed * after)[:, None] * comes_from
    return place.at[:, 2].add(-fallen)


def in_flight(throw: Throw, start: Array, goal: Array, time: Array, outside: Array) -> Array:
    """Returns whether each ball is there at `time` [] seconds: [N] bool.

    Args:
        start, goal: [3] metres, of the drone that is thrown at.
        outside: [N] bool, whether it is beyond the flight volume.
    """
    launched = time > hit_time(throw, start, goal) - throw.early
    return (throw.early > 0) & launched & ~outside


def top_throw_speed(throw: Throw, start: Array, goal: Array, time: Array) -> Array:
    """Returns the largest speed [] m/s of any of the balls at `time` [] seconds, launched or not."""
    after = time - hit_time(throw, start, goal)
    return jnp.max(jnp.where(throw.early > 0, throw.speed + throw.gravity * jnp.abs(after + throw.early / 2), 0.0))


def at_rest(*lead: int) -> Motion:
    """Returns the motion of shapes [*lead] that stand still."""
    return Motion(
        velocity=jnp.zeros((*lead, 3)),
        low=jnp.zeros((*lead, 3)),
        high=jnp.zeros((*lead, 3)),
        swing=jnp.zeros((*lead, 2, 3)),
        rate=jnp.zeros(lead),
        phase=jnp.zeros(lead),
    )


def not_thrown(*lead: int) -> Throw:
    """Returns the throw of spheres [*lead] that nobody throws."""
    return Throw(*[jnp.zeros(lead)] * 7)
