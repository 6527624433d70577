"""Random free points of a world, in all of its volume or in given cells of it."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jax.typing import ArrayLike

from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.scene import Scene, has_motion, scene_at

CLEARANCE = 1.0
"""Metres between a random start or goal and the nearest surface."""
FAR = 40.0
"""Least distance between a random start and a random goal, metres; in a small volume half of its length."""
TRIES = 64
"""Candidates for each free point; the chance that all fail is below 1e-13 in a dense world, and 3e-5 in rooms, where a
goal may then be nearer than it should."""

EARLY_S = 2.0
"""Seconds from the start of an episode during which a random point is free of shapes that move."""
_EARLY_STEP_S = 0.25  # what moves at 5 m/s comes no nearer between two samples than 0.625 m less than the clearance

ALTITUDES = (1.5, 20.0)
"""Of the start and goal of a random world, metres."""
_FENCE = ((1.0, 1.0, 1.0), (1.0, 1.0, 2.0))  # between random points and the volume's lower and upper faces


@struct.dataclass
class Cells:
    """Cubes of a grid that starts are drawn from."""

    is_one: Array  # [X, Y, Z] bool, which cubes of the grid
    chosen: Array  # [K, 3] int32, those of them that points all over are drawn from
    corner: Array  # [3] metres, middle of the grid's first cube
    edge_m: Array  # [] metres


def free_point(scene: Scene, key: Array) -> Array:
    """Returns a random free point [3] of the flight volume, metres; `key` is consumed, see `first_free`."""
    return first_free(scene, scatter_points(scene, jax.random.uniform(key, (TRIES, 3))), CLEARANCE)


def far_apart(scene: Scene, uniforms: Array) -> tuple[Array, Array]:
    """Returns a free start and a free goal, each [3], from uniform draws [2, K, 3].

    They are `FAR` metres apart, or half as far as the volume is long.
    """
    start = first_free(scene, scatter_points(scene, uniforms[0], ALTITUDES), CLEARANCE)
    return start, far_from(scene, uniforms[1], start)


def far_from(scene: Scene, uniforms: Array, point: Array) -> Array:
    """Returns a free point [3], metres, as far from `point` as a start is from its goal, from uniform draws [K, 3]."""
    distance = jnp.minimum(FAR, (scene.volume[1, 0] - scene.volume[0, 0]) / 2)
    return first_free(scene, scatter_points(scene, uniforms, ALTITUDES), CLEARANCE, point, distance)


def scatter_points(scene: Scene, uniforms: Array, altitudes: tuple[float, float] | None = None) -> Array:
    """Returns points [K, 3] of the flight volume, a margin inside its faces, from uniform draws [K, 3]."""
    lower, upper = inner_bounds(scene)
    if altitudes is not None:
        lower = lower.at[2].max(altitudes[0])
        upper = upper.at[2].min(altitudes[1])
    return lower[None] + uniforms * (upper - lower)[None]


def inner_bounds(scene: Scene) -> tuple[Array, Array]:
    """Returns the lower and the upper corner [3] of where random points may be, inside the faces of the volume."""
    return scene.volume[0] + jnp.array(_FENCE[0]), scene.volume[1] - jnp.array(_FENCE[1])


def cells_of(scene: Scene, is_one: np.ndarray, corner: np.ndarray, edge_m: float) -> Cells:
    """Returns those cubes of a grid that starts are drawn from; those near the volume's faces if there are no others.

    Args:
        scene: one world.
        is_one: [X, Y, Z] bool, which cubes they may be.
        corner: [3] metres, middle of the grid's first cube.
        edge_m: of the cubes, metres.
    """
    every = np.argwhere(is_one)
    lower, upper = map(np.asarray, inner_bounds(scene))
    middles = corner + edge_m * every
    inside = np.all((middles >= lower) & (middles <= upper), axis=1)
    return Cells(
        is_one=jnp.asarray(is_one),
        chosen=jnp.asarray(every[inside] if inside.any() else every, jnp.int32),
        corner=jnp.asarray(corner, jnp.float32),
        edge_m=jnp.float32(edge_m),
    )


def in_cells(cells: Cells, uniforms: Array) -> Array:
    """Returns points [K, 3] uniform over the cells, from uniform draws [K, 3]."""
    count = cells.chosen.shape[0]
    chosen = jnp.minimum((uniforms[:, 0] * count).astype(jnp.int32), count - 1)
    # The last digits of a number are as good as another one.
    within = jnp.stack([uniforms[:, 1], (1024.0 * uniforms[:, 1]) % 1.0, uniforms[:, 2]], axis=1) - 0.5
    return cells.corner[None] + cells.edge_m * (cells.chosen[chosen] + within)


def contains(cells: Cells, point: Array) -> Array:
    """Returns whether a point [3], metres, lies in one of the cells."""
    at = jnp.round((point - cells.corner) / cells.edge_m).astype(jnp.int32)
    inside = jnp.all((at >= 0) & (at < jnp.array(cells.is_one.shape)))
    x, y, z = jnp.clip(at, 0, jnp.array(cells.is_one.shape) - 1)
    return inside & cells.is_one[x, y, z]


def first_free(
    scene: Scene, points: Array, clearance: float, away_from: Array | None = None, distance: ArrayLike = 0.0
) -> Array:
    """Returns the first of `points` [K, 3], metres, that meets the conditions, or the one that violates them least.

    Where shapes move, a point is free if it is so at each of `early_times`; balls are not asked for.
    """
    short = jnp.minimum(least_distances(scene, points) - clearance, 0.0)
    if away_from is not None:
        apart = jnp.sqrt(jnp.sum((points - away_from[None]) ** 2, axis=1))
        short += jnp.minimum(apart - distance, 0.0)
    return points[jnp.argmax(short)]


def early_times() -> Array:
    """Returns times [T] from 0 to `EARLY_S` at which random points are free, seconds."""
    return jnp.linspace(0.0, EARLY_S, 1 + round(EARLY_S / _EARLY_STEP_S))


def least_distances(scene: Scene, points: Array) -> Array:
    """Returns the least distance [K] of points [K, 3] to the nearest surface at any of `early_times`, metres."""
    if not has_motion(scene):
        return jax.vmap(partial(signed_distance, scene))(points)
    unthrown = dataclasses.replace(scene, spheres=dataclasses.replace(scene.spheres, throw=None))

    def at(time: Array) -> Array:
        return jax.vmap(partial(signed_distance, scene_at(unthrown, time)))(points)

    return jnp.min(lax.map(at, early_times()), axis=0)
