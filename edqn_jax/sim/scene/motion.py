"""How shapes move: closed forms of the time of the episode, so that nothing is carried from decision to decision.

N is the capacity of the shapes' kind. Obstacles that move pass through each other and through all others.
"""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.sine import cosm1_and_sin


@struct.dataclass
class Motion:
    """How the shapes of one kind move: along a line between walls, on an ellipse, or both. Zeros stand still."""

    velocity: Array  # [N, 3] m/s at time 0; each component changes its sign at the walls
    low: Array  # [N, 3] metres, between which and `high` the centre moves along the axes of its velocity
    high: Array  # [N, 3] metres
    swing: Array  # [N, 2, 3] metres, conjugate half axes of the ellipse: towards where it is at time 0, and ahead
    rate: Array  # [N] rad/s


@struct.dataclass
class Throw:
    """Which spheres are thrown balls, when they are due, and from which direction they come.

    A ball is absent before its launch, and wherever it is outside of the flight volume.
    """

    share: Array  # [N] of the straight way, at which the ball would meet a drone that flies it at a steady pace
    early: Array  # [N] seconds before that at which it is launched; 0 of spheres that are not thrown
    speed: Array  # [N] m/s, without what gravity adds
    bearing: Array  # [N] rad to the left of the drone's straight way to its goal, from which it comes
    elevation: Array  # [N] rad over the horizon, from which it comes
    gravity: Array  # [N] m/s^2 downwards
    pace: Array  # [N] m/s, the steady pace that says when it is due


@struct.dataclass
class Aim:
    """Target and time of each thrown ball in one flight."""

    launch: Array  # [N] seconds of the episode; `NEVER` of balls that are yet to be thrown
    point: Array  # [N, 3] metres, where it would meet the drone
    heading: Array  # [N] rad, of the straight way to the goal


NEVER = 1e6
"""Seconds after every flight."""

LEAST_LAUNCH_M = 3.0
"""Metres from the drone at which a ball is launched at least, or as far as it flies until it would meet it."""

LEAST_FLOWN_M = 1.5
"""Metres that a ball flies at least until then, so that none hits within its first physics step."""

TIME_TOLERANCE_S = 1e-3
"""Times that differ by less are the same: times of physics steps are rounded. A ball is absent at its launch."""


@struct.dataclass
class DroneTracks:
    """Tracks of K other drones over n physics steps."""

    path: Array  # [K, n + 1, 3] metres, before the first physics step and after each
    radius: Array  # [K] metres, 0 of a drone that is absent
    began: Array  # [] seconds of the episode
    step_s: Array  # [] seconds between two places of the path


def positions_at(tracks: DroneTracks, time: Array) -> Array:
    """Returns the positions [K, 3] metres of these drones at `time` [] seconds, linear between physics steps."""
    last = tracks.path.shape[1] - 1
    steps = jnp.clip((time - tracks.began) / tracks.step_s, 0.0, last)
    # Times of physics steps are rounded, and no drone is interpolated towards `PARKED`.
    whole = jnp.round(steps)
    steps = jnp.where(jnp.abs(steps - whole) < 1e-2, whole, steps)
    before = jnp.clip(jnp.floor(steps).astype(jnp.int32), 0, last - 1)
    share = steps - before
    return tracks.path[:, before] + share * (tracks.path[:, before + 1] - tracks.path[:, before])


OUTSIDE_M = 1.0
"""Metres beyond the flight volume's faces at which a ball appears and is absent again, plus its radius: no drone is
so near."""


def displacement(motion: Motion, position: Array, time: Array) -> Array:
    """Returns how far the shapes have moved at `time` [] seconds: [N, 3] metres, exactly zero at time 0.

    A velocity is reflected at the walls: the position is a triangle wave of the time. The ellipse is
    a (cos(w t) - 1) + b sin(w t).

    Args:
        position: [N, 3] metres at time 0, between the walls where there is a velocity.
    """
    # One array per coordinate, so that CPUs take all shapes of a kind in vectors.
    back, ahead = cosm1_and_sin(motion.rate * time)
    around = [motion.swing[:, 0, axis] * back + motion.swing[:, 1, axis] * ahead for axis in range(3)]
    along = [_along(motion, position, axis, time) for axis in range(3)]
    return jnp.stack([line + turn for line, turn in zip(along, around, strict=True)], axis=1)


def _along(motion: Motion, position: Array, axis: int, time: Array) -> Array:
    """Returns how far the shapes have run between their walls along one axis: [N] metres."""
    place, velocity, low, high = (of[:, axis] for of in (position, motion.velocity, motion.low, motion.high))
    runs = velocity != 0
    both_ways = 2 * jnp.where(runs, high - low, 1.0)
    ahead = place - low + velocity * time
    # XLA's remainder of a division is a call of a library for each number on a CPU, and takes ten times as long.
    ahead = ahead - both_ways * jnp.floor(ahead / both_ways)
    return jnp.where(runs & (time != 0), low + both_ways / 2 - jnp.abs(ahead - both_ways / 2) - place, 0.0)


def top_speeds(motion: Motion) -> Array:
    """Returns a bound [N] m/s of the speed of each of the shapes at any time."""
    a, b = motion.swing[:, 0], motion.swing[:, 1]
    aa, bb, ab = (jnp.sum(x * y, axis=1) for x, y in ((a, a), (b, b), (a, b)))
    longest = jnp.sqrt((aa + bb) / 2 + jnp.sqrt(((aa - bb) / 2) ** 2 + ab**2))  # half axis of the ellipse
    line = jnp.sqrt(jnp.sum(motion.velocity**2, axis=1))
    return line + jnp.abs(motion.rate) * longest


def launch_times(throw: Throw, start: Array, goal: Array) -> Array:
    """Returns when the balls would be launched at a drone that flies from `start` to `goal` [3], metres: [N] s."""
    way = jnp.sqrt(jnp.sum((goal - start) ** 2))
    # Nothing is launched before the episode begins.
    return jnp.maximum(throw.share * way / jnp.maximum(throw.pace, 1e-6) - throw.early, 0.0)


def steady_aim(throw: Throw, start: Array, goal: Array) -> Aim:
    """Returns the aim at a drone that flies straight from `start` to `goal` [3], metres, at a steady pace.

    It is used without a flight: in pictures and files of a world alone.
    """
    way, launch = goal - start, launch_times(throw, start, goal)
    length = jnp.sqrt(jnp.sum(way**2))
    distance = jnp.minimum(throw.pace * (launch + throw.early), length)
    point = start[None] + (distance / jnp.maximum(length, 1e-6))[:, None] * way[None]
    return Aim(launch=launch, point=point, heading=jnp.full_like(launch, jnp.arctan2(way[1], way[0])))


def no_aim(throw: Throw) -> Aim:
    """Returns the aim of balls [N] before any is thrown."""
    return Aim(launch=jnp.full_like(throw.share, NEVER), point=jnp.zeros((*throw.share.shape, 3)), heading=throw.share)


def aim_at(throw: Throw, goal: Array, volume: Array, launch: Array, here: Array, moved: Array, step_s: float) -> Aim:
    """Returns the aim of balls at the drone's position extrapolated from its last decision.

    A ball that would then begin within `LEAST_LAUNCH_M` of the drone, and nearer than it flies, is aimed at the present
    position.

    Args:
        throw: of N balls.
        goal: [3] metres, of the drone.
        volume: [2, 3] metres; no drone flies outside of it, so no ball is aimed there.
        launch: [N] or [] seconds of the episode, the beginning of a decision.
        here: [3] or [N, 3] metres, where the drone is then.
        moved: likewise, how far it has come within the decision before; 0 at a start.
        step_s: length of a decision, seconds.
    """
    count = throw.early.shape[0]
    here, moved = jnp.broadcast_to(here, (count, 3)), jnp.broadcast_to(moved, (count, 3))
    low, high = (jnp.broadcast_to(corner, (count, 3)) for corner in volume)
    ahead = jnp.clip(here + moved * (throw.early / step_s)[:, None], low, high)
    way = goal[None] - here
    heading = jnp.arctan2(way[:, 1], way[:, 0])
    away = ahead + (throw.speed * throw.early)[:, None] * _comes_from(throw, heading) - here
    least = jnp.minimum(throw.speed * throw.early, LEAST_LAUNCH_M)
    near = jnp.sum(away**2, axis=1) < least**2
    point = jnp.where(near[:, None], here, ahead)
    return Aim(launch=jnp.broadcast_to(launch, (count,)), point=point, heading=heading)


def _comes_from(throw: Throw, heading: Array) -> Array:
    """Returns the directions [N, 3] from which balls come, given the headings [N] rad of ways to goals."""
    turned, level = heading + throw.bearing, jnp.cos(throw.elevation)
    return jnp.stack([level * jnp.cos(turned), level * jnp.sin(turned), jnp.sin(throw.elevation)], axis=1)


def ball_positions(throw: Throw, aim: Aim, time: Array) -> Array:
    """Returns where the balls are at `time` [] seconds: [N, 3] metres, whether or not they have been launched.

    Without gravity it is a straight line; with it, the parabola from the same point of launch to the same hit.
    """
    after = time - aim.launch - throw.early
    fallen = 0.5 * throw.gravity * after * (after + throw.early)
    place = aim.point - (throw.speed * after)[:, None] * _comes_from(throw, aim.heading)
    return place.at[:, 2].add(-fallen)


def in_flight(throw: Throw, aim: Aim, time: Array, outside: Array) -> Array:
    """Returns whether each ball is there at `time` [] seconds: [N] bool.

    Args:
        outside: [N] bool, whether it is beyond the flight volume.
    """
    return (throw.early > 0) & (time > aim.launch + TIME_TOLERANCE_S) & ~outside


def throw_speeds(throw: Throw, aim: Aim, time: Array) -> Array:
    """Returns a bound [N] m/s of the speeds of balls at `time` [] seconds, convex in time; 0 before their launch."""
    after = time - aim.launch - throw.early
    speed = throw.speed + jnp.abs(throw.gravity * (after + throw.early / 2))
    return jnp.where((throw.early > 0) & (time > aim.launch + TIME_TOLERANCE_S), speed, 0.0)


def at_rest(*lead: int) -> Motion:
    """Returns the motion of shapes [*lead] that stand still."""
    return Motion(
        velocity=jnp.zeros((*lead, 3)),
        low=jnp.zeros((*lead, 3)),
        high=jnp.zeros((*lead, 3)),
        swing=jnp.zeros((*lead, 2, 3)),
        rate=jnp.zeros(lead),
    )


def not_thrown(*lead: int) -> Throw:
    """Returns a `Throw` of zeros for spheres [*lead] that are not thrown."""
    return Throw(*[jnp.zeros(lead)] * 7)
