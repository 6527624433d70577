"""Missions: a world, a start and a goal."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from jax.typing import ArrayLike

from edqn_jax.kept_programs import kept_jit
from edqn_jax.sim.scene.scene import Scene, take_scene
from edqn_jax.sim.worlds.free_points import (
    CLEARANCE,
    TRIES,
    Cells,
    contains,
    far_apart,
    far_from,
    first_free,
    in_cells,
    scatter_points,
)

AWAY = 5.0
"""Least distance between a random start and a given goal, metres."""


@struct.dataclass
class Missions:
    """M missions: in which world, from where, to where."""

    scene: Array  # [M] int32, index into the pool of worlds
    start: Array  # [M, 3] metres
    goal: Array  # [M, 3] metres


def own_missions(pool: Scene) -> Missions:
    """Returns one mission for each world of the pool [P]: from its own start to its own goal."""
    return Missions(scene=jnp.arange(pool.start.shape[0]), start=pool.start, goal=pool.goal)


@kept_jit(1, 3)
def random_missions(pool: Scene, count: int, key: Array, own_goals: bool = False) -> Missions:
    """Returns missions in random worlds of the pool between random free points, as far apart as in `far_apart`.

    Args:
        pool: worlds [P].
        count: M.
        key: consumed.
        own_goals: whether all missions in a world end at its own goal.
    """

    def mission(index: Array, uniforms: Array) -> Missions:
        scene = take_scene(pool, index)
        if own_goals:
            # The same conditions with the ends exchanged.
            return Missions(scene=index, start=far_from(scene, uniforms[0], scene.goal), goal=scene.goal)
        start, goal = far_apart(scene, uniforms)
        return Missions(scene=index, start=start, goal=goal)

    scene_key, points_key = jax.random.split(key)
    index = jax.random.randint(scene_key, (count,), 0, pool.start.shape[0])
    return jax.vmap(mission)(index, jax.random.uniform(points_key, (count, 2, TRIES, 3)))


@kept_jit(1)
def spread_missions(
    pool: Scene,
    count: int,
    own_start_fraction: ArrayLike,
    jitter: ArrayLike,
    key: Array,
    cells: Cells | None = None,
) -> Missions:
    """Returns missions to the worlds' own goals, from starts spread over the volume.

    The other starts are free points, at least `AWAY` metres from the goal.

    Args:
        pool: worlds [P]; missions draw from them at random.
        count: M.
        own_start_fraction: share of missions that begin near the world's own start.
        jitter: half width, metres, of the box around the own start that these are drawn from, cut off 0.5 m
            inside the volume; 0 is the start itself.
        key: consumed.
        cells: of the only world, where starts may be: in closed spaces there may be no way to the goal. None is
            everywhere.
    """

    def mission(own: Array, index: Array, uniforms: Array) -> Missions:
        scene = take_scene(pool, index)
        points = scatter_points(scene, uniforms[0]) if cells is None else in_cells(cells, uniforms[0])
        anywhere = first_free(scene, points, CLEARANCE, scene.goal, AWAY)
        lower = jnp.minimum(scene.volume[0] + 0.5, scene.start)
        upper = jnp.maximum(scene.volume[1] - 0.5, scene.start)
        # The start itself comes last: it is chosen if no other candidate is free.
        shift = (jnp.asarray(jitter) * (2.0 * uniforms[1] - 1.0)).at[-1].set(0.0)
        near = jnp.clip(scene.start[None] + shift, lower[None], upper[None])
        if cells is not None:
            near = jnp.where(jax.vmap(partial(contains, cells))(near)[:, None], near, scene.start)
        start = jnp.where(own, first_free(scene, near, CLEARANCE), anywhere)
        return Missions(scene=index, start=start, goal=scene.goal)

    order_key, scene_key, points_key = jax.random.split(key, 3)
    own = jax.random.permutation(order_key, jnp.arange(count) < jnp.round(own_start_fraction * count))
    index = jax.random.randint(scene_key, (count,), 0, pool.start.shape[0])
    return jax.vmap(mission)(own, index, jax.random.uniform(points_key, (count, 2, TRIES, 3)))
