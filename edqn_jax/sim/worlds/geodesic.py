"""Distance to the goal around obstacles: a field per world, for the reward `geodesic`.

A lattice of nodes over the volume, each of which has room for the drone. Around a node a ball with the radius of its
clearance is free, so wherever two balls meet, a point passes straight from node to node: through a gap that is a little
too narrow for the drone, never through a wall. A node holds the length of the shortest such way to the goal.
"""

from __future__ import annotations

import itertools
import math
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from edqn_jax.kept_programs import kept_jit
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.worlds.sweeps import spread, steps_aside

MAX_NODES = 500_000
"""Nodes of the field of a single world."""
FINEST_M = 0.5
"""Edge of the lattice at least, metres."""
POOL_NODES = (40, 40, 9)
"""Nodes of the field of each world of a pool, whatever its volume."""

MAX_LATTICE_RATIO = 1.13
"""Lengths along axes and diagonals over straight ones, at most."""

_BATCH = 128  # worlds of a pool

_LEAST = 1e-6  # of weights that are worth dividing by
_CORNERS = np.array([*itertools.product((0, 1), repeat=3)])


@struct.dataclass
class Field:
    """Ways to the goals of P worlds, on X x Y x Z nodes each."""

    remaining: Array  # [P, X, Y, Z] metres from a node to the goal; inf where there is no way
    clearance: Array  # [P, X, Y, Z] metres from a node to the nearest surface, at least 0
    corner: Array  # [P, 3] metres, the first node
    edge: Array  # [P] metres


def nodes_per_side(size: tuple[float, float, float]) -> tuple[int, int, int]:
    """Returns the number of nodes along each side of a volume, metres, with about `MAX_NODES` in all, or fewer."""
    edge = max(FINEST_M, (math.prod(size) / MAX_NODES) ** (1 / 3))
    across, along, levels = (max(2, math.ceil(side / edge)) for side in size)
    return across, along, levels


def distance_fields(pool: Scene, radius: float) -> Field:
    """Returns the fields of a pool of worlds [P], whose nodes have `radius` metres of room; of a single world, finer.

    Its arrays are on the host: of many worlds they take gigabytes.
    """
    worlds = pool.start.shape[0]
    across, along, high = map(float, pool.volume[0, 1] - pool.volume[0, 0])
    shape = POOL_NODES if worlds > 1 else nodes_per_side((across, along, high))
    parts = [jax.tree.map(lambda leaf, i=i: leaf[i : i + _BATCH], pool) for i in range(0, worlds, _BATCH)]
    # XLA uses one core for a part.
    with ThreadPoolExecutor(thread_name_prefix="ways") as threads:
        found = list(threads.map(lambda part: jax.tree.map(np.asarray, _fields(part, shape, radius)), parts))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *found)


@kept_jit(1, 2)
def _fields(pool: Scene, shape: tuple[int, int, int], radius: float) -> Field:
    return jax.vmap(lambda scene: _field(scene, shape, radius))(pool)


def _field(scene: Scene, shape: tuple[int, int, int], radius: float) -> Field:
    sides = scene.volume[1] - scene.volume[0]
    edge = jnp.max(sides / jnp.array(shape, jnp.float32))
    # In the middle of the volume, where it has fewer nodes than fit.
    corner = scene.volume[0] + (sides - edge * (jnp.array(shape, jnp.float32) - 1.0)) / 2
    y, z = (corner[axis] + edge * jnp.arange(shape[axis]) for axis in (1, 2))

    def clearances(x: Array) -> Array:
        at = lambda y, z: signed_distance(scene, jnp.stack([x, y, z]))  # noqa: E731
        return jax.vmap(lambda y: jax.vmap(lambda z: at(y, z))(z))(y)

    clearance = lax.map(clearances, corner[0] + edge * jnp.arange(shape[0]))
    points = _positions(corner, edge, shape)
    lower, upper = scene.volume[0, None, None, None], scene.volume[1, None, None, None]
    inside = jnp.all((points >= lower) & (points <= upper), axis=-1)
    is_free = inside & (clearance >= radius)
    apart = jnp.sqrt(jnp.sum((points - scene.goal[None, None, None]) ** 2, axis=-1))
    seen = is_free & (apart <= jnp.maximum(clearance, signed_distance(scene, scene.goal)))
    # Where not even the ball around a node reaches the goal, the way begins at the nearest nodes.
    seen = jnp.where(jnp.any(seen), seen, is_free & (apart <= math.sqrt(3) * edge))
    lengths = edge * jnp.sqrt(1.0 + jnp.sum(jnp.asarray(steps_aside(1)) ** 2, axis=1))
    balls = jnp.where(is_free, clearance, -jnp.inf)
    remaining = spread(jnp.where(seen, apart, jnp.inf), balls, jnp.broadcast_to(lengths, (3, *lengths.shape)))
    return Field(remaining=remaining, clearance=jnp.where(is_free, clearance, 0.0), corner=corner, edge=edge)


def _positions(corner: Array, edge: Array, shape: tuple[int, int, int]) -> Array:
    """Returns the positions of the nodes [X, Y, Z, 3], metres."""
    grid = jnp.stack(jnp.meshgrid(*(jnp.arange(n, dtype=jnp.float32) for n in shape), indexing="ij"), axis=-1)
    return corner[None, None, None] + edge * grid


def distance_to_goal(of: Field, world: Array, goal: Array, point: Array) -> Array:
    """Returns the distance from a point [3] to the goal [3] in one of the worlds, metres.

    It is interpolated between those nodes of the point's cell whose balls hold the point, which count the more the
    deeper they hold it; where none does, the way leads over the best of the free ones; where there is none of these
    either, it is the straight line.

    Args:
        of: the worlds' fields.
        world: [] int32, which world.
    """
    of = jax.tree.map(jnp.asarray, of)  # from the host, where a traced number is no index
    corner, edge, shape = of.corner[world], of.edge[world], jnp.array(of.remaining.shape[1:])
    at = ((point - corner) / edge)[None]
    cells = jnp.clip(jnp.floor(at).astype(jnp.int32) + jnp.asarray(_CORNERS), 0, shape[None] - 1)
    x, y, z = cells[:, 0], cells[:, 1], cells[:, 2]
    left, clearance = of.remaining[world, x, y, z], of.clearance[world, x, y, z]
    apart = jnp.sqrt(jnp.sum((corner[None] + edge * cells - point[None]) ** 2, axis=1))
    near = jnp.prod(jnp.clip(1.0 - jnp.abs(at - cells), 0.0, 1.0), axis=1)
    weight = near * jnp.clip((clearance - apart) / edge, 0.0, 1.0) * jnp.isfinite(left)
    total = jnp.sum(weight)
    between = jnp.sum(weight * jnp.where(weight > 0.0, left, 0.0)) / jnp.maximum(total, _LEAST)
    over = jnp.min(jnp.where(clearance > 0.0, left + apart, jnp.inf))
    straight = jnp.sqrt(jnp.sum((goal - point) ** 2))
    found = jnp.where(total > _LEAST, between, over)
    return jnp.where(jnp.isfinite(found), jnp.maximum(found, straight), straight)
