"""Random worlds in which obstacles move and balls are thrown: motion that is drawn for a world that stands."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from edqn_jax.config import Config
from edqn_jax.sim.scene.distance import shape_distances
from edqn_jax.sim.scene.motion import Motion, Throw, at_rest
from edqn_jax.sim.scene.scene import PARKED, Scene, Spheres, scene_at
from edqn_jax.sim.scene.shapes.kind import reach_of
from edqn_jax.sim.worlds import building
from edqn_jax.sim.worlds.free_points import CLEARANCE, early_times

Bodies = Mapping[str, tuple[int, ...]]
"""By kind of shape, the number of the body that each shape is part of; what is in no body stands."""

MOVING_SHARE = 0.5
"""Share of the obstacles that move in the worlds `moving`, where `world.moving_share` is 0."""
SLOWEST = 0.3
"""Speed of the slowest obstacle that moves, in shares of the fastest."""
SWING = (1.0, 4.0)
"""Amplitude of what sways, and radius of what circles, metres."""
SHARES = (0.2, 0.95)
"""Where balls meet the drone, in shares of its way."""
BEARING = math.radians(40.0)
"""Balls come from at most so far to either side of the way to the goal, so that a drone that hovers or flies straight
has them in its image."""
ELEVATION = math.radians(20.0)
"""Balls come from at most so far above the horizon."""


@dataclasses.dataclass(frozen=True)
class Moving:
    """Motion in random worlds, from options of `world`; none by default."""

    share: float = 0.0
    speed_m_s: float = 3.0
    balls: int = 0
    ball_speed_m_s: float = 6.0
    ball_slowest: float = 1.0
    ball_seconds: tuple[float, float] = (1.5, 3.0)
    ball_radii_m: tuple[float, float] = (0.3, 0.5)
    ball_gravity_m_s2: float = 0.0
    pace_m_s: float = 4.0
    """Of the drone that balls are thrown at."""

    @classmethod
    def from_config(cls, config: Config) -> Moving:
        """Returns the motion options of a configuration's random worlds."""
        world = config.world
        return cls(
            share=world.moving_share,
            speed_m_s=world.moving_speed_m_s,
            balls=world.balls,
            ball_speed_m_s=world.ball_speed_m_s,
            ball_slowest=world.ball_slowest,
            ball_seconds=world.ball_seconds,
            ball_radii_m=world.ball_radii_m,
            ball_gravity_m_s2=world.ball_gravity_m_s2,
            pace_m_s=config.env.speed_m_s,
        )


STILL = Moving()
"""Nothing moves."""


def in_motion(scene: Scene, moving: Moving, bodies: Bodies, key: Array) -> Scene:
    """Returns a static world with motion added; at time 0 it is unchanged.

    Each body moves with probability `moving.share`: a third of those that move run along a straight line between the
    faces of the volume, a third sway along a line, a third circle, all of them level and at a steady speed (swaying: at
    most) from `SLOWEST` to 1 times `moving.speed_m_s`. Bodies of several shapes never run. A body that would come
    nearer than `CLEARANCE` to start or goal within the first seconds (`early_times`) stands.

    Args:
        scene: one world.
        moving: what moves; static.
        bodies: of the world's family; static.
        key: consumed.
    """
    obstacles, balls = jax.random.split(key)
    if moving.share and bodies:
        scene = _with_moving_bodies(scene, moving, bodies, obstacles)
    return _with_balls(scene, moving, balls) if moving.balls else scene


def _with_moving_bodies(scene: Scene, moving: Moving, bodies: Bodies, key: Array) -> Scene:
    count = 1 + max(max(numbers) for numbers in bodies.values())
    drawn = _motions(moving, jax.random.uniform(key, (count, 6)), runs=_are_single(bodies, count))

    def kept(keep: Array) -> Scene:
        """The world in which these bodies [count] bool move."""
        fields: dict[str, Any] = {}
        for kind, numbers in bodies.items():
            shapes, of = scene.shapes()[kind], np.array(numbers)
            moves = keep[of] & (shapes.position[:, 0] < PARKED / 2)
            motion = jax.tree.map(lambda leaf, of=of: leaf[of], drawn)
            motion = _between_faces(motion, shapes, scene.volume)
            stands = at_rest(len(of))
            motion = jax.tree.map(
                lambda a, b, m=moves: jnp.where(m.reshape(-1, *[1] * (a.ndim - 1)), a, b), motion, stands
            )
            fields[kind] = dataclasses.replace(shapes, motion=motion)
        return scene.with_shapes(fields)

    everything = kept(jnp.ones(count, bool))

    def nearest(time: Array) -> dict[str, Array]:
        now = scene_at(everything, time)
        start, goal = shape_distances(now, scene.start), shape_distances(now, scene.goal)
        return {kind: jnp.minimum(start[kind], goal[kind]) for kind in bodies}

    free = {kind: jnp.min(each, axis=0) >= CLEARANCE for kind, each in lax.map(nearest, early_times()).items()}
    keep = jnp.ones(count, bool)
    for kind, numbers in bodies.items():
        keep = keep.at[np.array(numbers)].min(free[kind])
    return kept(keep)


def _are_single(bodies: Bodies, count: int) -> bool:
    """Returns whether every body is one shape."""
    return sum(len(numbers) for numbers in bodies.values()) == count


def _motions(moving: Moving, uniforms: Array, runs: bool) -> Motion:
    """Returns the motions of bodies [B] from uniform draws [B, 6], without walls; a share of them stands."""
    speed = moving.speed_m_s * building.scale_uniforms((SLOWEST, 1.0), uniforms[:, 1])
    heading, phase = 2 * jnp.pi * uniforms[:, 2], 2 * jnp.pi * uniforms[:, 3]
    reach = building.scale_uniforms(SWING, uniforms[:, 4])
    sort = jnp.floor(uniforms[:, 5] * 3 if runs else 1 + uniforms[:, 5] * 2)
    go = uniforms[:, 0] < moving.share
    none = jnp.zeros_like(reach)
    along = jnp.stack([jnp.cos(heading), jnp.sin(heading), none], axis=1)
    across = jnp.stack([-jnp.sin(heading), jnp.cos(heading), none], axis=1)
    turns = jnp.where(uniforms[:, 2] * 1024.0 % 1.0 < 0.5, -1.0, 1.0)  # of either hand
    # It is somewhere on its line or circle at time 0, as far as `phase` says.
    circle = jnp.where((go & (sort == 2))[:, None], reach[:, None] * across, 0.0)
    line = jnp.where((go & (sort > 0))[:, None], reach[:, None] * along, 0.0)
    cos, sin = jnp.cos(phase)[:, None], jnp.sin(phase)[:, None]
    swing = jnp.stack([cos * circle + sin * line, cos * line - sin * circle], axis=1)
    return Motion(
        velocity=jnp.where((go & (sort == 0))[:, None], speed[:, None] * along, 0.0),
        low=jnp.zeros_like(along),
        high=jnp.zeros_like(along),
        swing=swing,
        rate=jnp.where(go, turns * speed / reach, 0.0),
    )


def _between_faces(motion: Motion, shapes: Any, volume: Array) -> Motion:
    """Returns the motion with walls between which the shapes stay within the faces of the volume."""
    reach = reach_of(shapes) * jnp.array([[1.0, 1.0, 0.0]])
    return dataclasses.replace(motion, low=volume[0][None] + reach, high=volume[1][None] - reach)


def _with_balls(scene: Scene, moving: Moving, key: Array) -> Scene:
    """Returns the world with balls that are thrown at the drone on its way; the first meets it first."""
    count, differ = moving.balls, moving.ball_slowest < 1
    uniforms = jax.random.uniform(key, (count, 5 + building.COLOUR_DRAWS + differ))
    share = building.scale_uniforms(SHARES, (jnp.arange(count) + uniforms[:, 0]) / count)
    one = jnp.ones(count)
    speed = moving.ball_speed_m_s * one
    if differ:
        speed = speed * building.scale_uniforms((moving.ball_slowest, 1.0), uniforms[:, -1])
    throw = Throw(
        share=share,
        early=building.scale_uniforms(moving.ball_seconds, uniforms[:, 1]),
        speed=speed,
        bearing=BEARING * (2 * uniforms[:, 2] - 1),
        elevation=ELEVATION * uniforms[:, 3],
        gravity=moving.ball_gravity_m_s2 * one,
        pace=moving.pace_m_s * one,
    )
    balls = Spheres(
        position=jnp.full((count, 3), PARKED),
        radius=building.scale_uniforms(moving.ball_radii_m, uniforms[:, 4]),
        albedo=building.make_albedos(uniforms[:, 5 : 5 + building.COLOUR_DRAWS]),
        motion=None if scene.spheres.motion is None else at_rest(count),
        throw=throw,
    )
    nobody = jax.tree.map(lambda leaf: jnp.zeros((scene.spheres.radius.shape[0], *leaf.shape[1:])), throw)
    others = dataclasses.replace(scene.spheres, throw=nobody)
    joined = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), others, balls)
    return dataclasses.replace(scene, spheres=joined)
