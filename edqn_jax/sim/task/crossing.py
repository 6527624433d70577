"""Missions of several drones in one world whose ways cross.

A block of N missions in a row is flown by one group. Starts stand around a common point, each goal is opposite its
start, so straight ways meet near that point after about the same time.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax

from edqn_jax.kept_programs import kept_jit
from edqn_jax.sim.scene.scene import PARKED, Scene, take_scene
from edqn_jax.sim.task.missions import Missions
from edqn_jax.sim.worlds.free_points import ALTITUDES, CLEARANCE, FAR, TRIES, inner_bounds, least_distances

APART = 5.0
"""Metres between any two starts of a block, and between any two goals: both goal spheres and drones have room."""
MAX_DETOUR = 1.5
"""Ways are at most so many times as long as the shortest of random missions."""
LEVEL = 2.0
"""Starts and goals are at most so many metres above or below the common point, if there is room."""
ASIDE = 12.0
"""The last candidate for a start or a goal is at most so many metres from the place on the circle."""
OFF_CENTRE = 0.1
"""How far the common point is from the middle of the volume at most, in shares of its sides."""
TURN = 0.5
"""How far a start may be turned about the common point at most, in shares of the angle between two."""


@kept_jit(1, 2)
def crossing_missions(pool: Scene, drones: int, blocks: int, key: Array) -> Missions:
    """Returns `blocks` x `drones` missions in random worlds of the pool [P]; each block is of one world.

    Args:
        pool: worlds.
        drones: N, of a block.
        blocks: how many.
        key: consumed.
    """
    world_key, block_key = jax.random.split(key)
    index = jax.random.randint(world_key, (blocks,), 0, pool.start.shape[0])
    return _in_worlds(pool, drones, index, jax.random.split(block_key, blocks))


@kept_jit(1)
def own_crossings(pool: Scene, drones: int, keys: Array) -> Missions:
    """Returns one block of N = `drones` missions for each world of the pool [P], from `keys` [P], consumed."""
    return _in_worlds(pool, drones, jnp.arange(pool.start.shape[0]), keys)


def _in_worlds(pool: Scene, drones: int, index: Array, keys: Array) -> Missions:
    # One after the other: a block has as many candidates as many single missions.
    ends = lax.map(
        lambda each: sample_crossing(take_scene(pool, each[0]), drones, each[1]), (index, keys), batch_size=64
    )
    start, goal = (end.reshape(-1, 3) for end in ends)
    return Missions(scene=jnp.repeat(index, drones), start=start, goal=goal)


def sample_crossing(scene: Scene, drones: int, key: Array) -> tuple[Array, Array]:
    """Returns starts and goals [N, 3], metres, of drones whose straight ways meet near a common point.

    All are free as those of other missions are, starts `APART` from each other and goals, too, and each goal is as far
    from its start as in `free_points.far_apart`, at most `MAX_DETOUR` times as far, if candidates allow. Where no
    candidate meets all of this, it is the one that violates it least.

    Args:
        scene: one world.
        drones: N.
        key: consumed.
    """
    lower, upper = inner_bounds(scene)
    lower, upper = lower.at[2].max(ALTITUDES[0]), upper.at[2].min(ALTITUDES[1])
    middle_key, turn_key, start_key, goal_key = jax.random.split(key, 4)
    uniforms = jax.random.uniform(middle_key, (5,))
    middle = lower + (0.5 + OFF_CENTRE * (2 * uniforms[:3] - 1)).at[2].set(uniforms[2]) * (upper - lower)
    least = jnp.minimum(FAR, (scene.volume[1, 0] - scene.volume[0, 0]) / 2)
    radius = least / 2 * (1 + (MAX_DETOUR - 1) * uniforms[3])
    turns = jnp.arange(drones) + TURN * (jax.random.uniform(turn_key, (drones,)) - 0.5)
    angle = 2 * jnp.pi * (uniforms[4] + turns / drones)
    around = radius * jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros(drones)], axis=1)

    def near(place: Array, draws: Array) -> Array:
        """Returns candidates [K, 3]: the first at the place itself, later ones from a growing region around it."""
        reach = jnp.linspace(0.0, 1.0, TRIES)[:, None] * jnp.array([ASIDE, ASIDE, LEVEL])
        return jnp.clip(place[None] + reach * (2 * draws - 1), lower[None], upper[None])

    def placed(places: Array, draws: Array, froms: Array, least: Array) -> Array:
        """Returns free points [N, 3] near places, apart from each other, each `least` from its point of `froms`."""

        def one(chosen: Array, each: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
            number, place, uniforms, begin = each
            points = near(place, uniforms)
            short = jnp.minimum(least_distances(scene, points) - CLEARANCE, 0.0)
            short += jnp.minimum(jnp.min(_pair_distances(points, chosen), axis=1) - APART, 0.0)
            short += jnp.minimum(_pair_distances(points, begin[None])[:, 0] - least, 0.0)
            found = points[jnp.argmax(short)]
            return chosen.at[number].set(found), found

        nobody = jnp.full((drones, 3), PARKED)
        return lax.scan(one, nobody, (jnp.arange(drones), places, draws, froms))[1]

    shape = (drones, TRIES, 3)
    start = placed(middle + around, jax.random.uniform(start_key, shape), jnp.full((drones, 3), PARKED), jnp.zeros(()))
    # Opposite the start as it is, so that the way passes the common point.
    opposite = 2 * middle[None] - start
    goal = placed(opposite, jax.random.uniform(goal_key, shape), start, least)
    return start, goal


def _pair_distances(points: Array, others: Array) -> Array:
    """Returns metres [K, A] between points [K, 3] and others [A, 3]."""
    return jnp.sqrt(jnp.sum((points[:, None] - others[None]) ** 2, axis=-1))
