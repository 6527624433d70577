"""Random worlds and their seeds, and missions: a world, a start and a goal."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import ArrayLike

from edqn_jax.config import DENSITIES
from edqn_jax.errors import ConfigError
from edqn_jax.random import integers
from edqn_jax.sim.scene import (
    PARKED,
    Capsules,
    Planes,
    Scene,
    Spheres,
    TiltedBoxes,
    TiltedCylinders,
    UprightBoxes,
    UprightCylinders,
    no_shapes,
    signed_distance,
    take_scene,
)

SIZE = (110.0, 110.0, 25.0)
"""Flight volume of a random world, metres: the paper's."""
SHAPES = {"sparse": (8, 2, 2), "medium": (22, 5, 3), "dense": (44, 10, 6)}
"""Blocks, pillars and balls of a random world, if all find a place. Medium is the paper's density."""
MIXED = "mixed"
"""Name of random worlds each of which has one of the three densities, with equal chances."""
HALF_WIDTHS = {"sparse": (2.0, 5.5), "medium": (2.0, 5.5), "dense": (1.5, 4.0)}
"""Range of a block's half width and half depth, metres."""
GAP = 3.0
"""Free metres between the footprints of any two shapes, and between them and the faces of the volume."""
CLEARANCE = 1.0
"""Metres between a random start or goal and the nearest surface."""
FAR = 40.0
"""Least distance between a random start and a random goal, metres."""
AWAY = 5.0
"""Least distance between a random start and a given goal, metres."""
GROUND_RGB = (0.37, 0.43, 0.35)
"""Albedo of the ground."""

_ALTITUDES = (1.5, 20.0)  # of the start and goal of a random world, metres
_FENCE = ((1.0, 1.0, 1.0), (1.0, 1.0, 2.0))  # between random points and the volume's lower and upper faces
_DENSITY = 1_000_003  # folded into the key of a mixed world to draw its density
_TRIES = 64  # candidates for each free point; the chance that all fail is below 1e-13 in a dense world
_PLACES = 64  # candidate positions for each shape

# ------------------------------------------------------------------------------------------- seeds

Split = Literal["training", "validation", "test"]
SPLITS: dict[Split, int] = {"training": 0, "validation": 1, "test": 2}
"""The three ranges of random worlds. They are disjoint by construction: a world's key is the fixed root
folded with its split's number, then with its index in the split."""
_ROOT_SEED = 2024


def world_key(split: Split, index: ArrayLike) -> Array:
    """Returns the key of world `index` (any non-negative integer) of a split."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(_ROOT_SEED), SPLITS[split]), index)


def world_keys(split: Split, count: int, first: int = 0) -> Array:
    """Returns the keys [count] of worlds `first`, `first + 1`, ... of a split."""
    return jax.vmap(partial(world_key, split))(first + jnp.arange(count))


# ------------------------------------------------------------------------------------ random worlds


@partial(jax.jit, static_argnums=0)
def random_scene(density: str, key: Array) -> Scene:
    """Returns a random world: blocks, pillars and balls over level ground, a start and a goal.

    The free space is connected by construction, so there is always a path from start to goal. The
    footprints' bounding circles are `GAP` apart and `GAP` inside the volume; grown by the drone's radius
    (0.36 m) they are still disjoint discs inside the rectangle, and a rectangle without finitely many
    disjoint discs in its interior is connected. That holds at every altitude, since no shape is wider
    anywhere than its footprint. A point above or below a shape is no exception: moving level and straight
    away from the shape's middle, it comes no closer to that shape and reaches the rim of its disc before
    any other disc begins. So every free point is connected to the free space between the discs.

    Args:
        density: `sparse`, `medium`, `dense`, or `mixed`.
        key: consumed.

    Raises:
        ConfigError: if the density is unknown.
    """
    if density not in DENSITIES:
        raise ConfigError(f"unknown density '{density}'; the densities are {', '.join(DENSITIES)}")
    blocks, pillars, balls = capacities(density)
    count = blocks + pillars + balls
    wanted, (narrow, wide) = _shapes_wanted(density, key)
    # One draw for all: on CPU each separate draw costs half a second of compilation.
    draws = jax.random.uniform(key, (count * (4 + 2 * _PLACES + 5) + 2 * _TRIES * 3,))
    sizes, places, colours, ends = jnp.split(
        draws, [count * 4, count * (4 + 2 * _PLACES), count * (4 + 2 * _PLACES + 5)]
    )
    draw = sizes.reshape(count, 4)
    first, second = blocks, blocks + pillars
    sides = narrow + (wide - narrow) * draw[:first, :2]
    block_height = 4.0 + 20.0 * draw[:first, 2]
    yaw = jnp.pi * draw[:first, 3]
    pillar_radius, pillar_height = 0.5 + 1.5 * draw[first:second, 0], 8.0 + 17.0 * draw[first:second, 1]
    ball_radius = 1.5 + 2.5 * draw[second:, 0]
    # From resting on the ground to hanging 2 m below the ceiling.
    ball_height = ball_radius + draw[second:, 1] * (SIZE[2] - 2.0 - 2.0 * ball_radius)

    reach = jnp.concatenate([jnp.hypot(sides[:, 0], sides[:, 1]), pillar_radius, ball_radius])
    x, y, placed = _place(reach, places.reshape(count, _PLACES, 2), wanted)
    z = jnp.concatenate([block_height / 2, pillar_height / 2, ball_height])
    position = jnp.where(placed[:, None], jnp.stack([x, y, z], axis=1), PARKED)
    albedo = _colours(colours.reshape(count, 5))

    here = placed.astype(jnp.float32)
    scene = Scene(
        boxes=UprightBoxes(
            position=position[:first],
            half=jnp.column_stack([sides, block_height / 2]) * here[:first, None],
            yaw=yaw * here[:first],
            albedo=albedo[:first],
        ),
        cylinders=UprightCylinders(
            position=position[first:second],
            radius=pillar_radius * here[first:second],
            half_height=pillar_height / 2 * here[first:second],
            albedo=albedo[first:second],
        ),
        spheres=Spheres(position=position[second:], radius=ball_radius * here[second:], albedo=albedo[second:]),
        tilted_boxes=no_shapes(TiltedBoxes),
        capsules=no_shapes(Capsules),
        tilted_cylinders=no_shapes(TiltedCylinders),
        planes=Planes(position=jnp.zeros((1, 3)), normal=jnp.array([[0.0, 0.0, 1.0]]), albedo=jnp.array([GROUND_RGB])),
        volume=jnp.array([(0.0, 0.0, 0.0), SIZE]),
        start=jnp.zeros(3),
        goal=jnp.zeros(3),
    )
    start, goal = _far_apart(scene, ends.reshape(2, _TRIES, 3))
    return dataclasses.replace(scene, start=start, goal=goal)


def capacities(density: str) -> tuple[int, int, int]:
    """Returns the most blocks, pillars and balls of a random world."""
    if density == MIXED:
        blocks, pillars, balls = zip(*SHAPES.values(), strict=True)
        return max(blocks), max(pillars), max(balls)
    return SHAPES[density]


def _shapes_wanted(density: str, key: Array) -> tuple[Array, Array]:
    """Returns which shapes [N] a world shall have, and the range [2] of its blocks' half widths."""
    most = capacities(density)
    if density != MIXED:
        return jnp.ones(sum(most), bool), jnp.asarray(HALF_WIDTHS[density])
    kind = integers(jax.random.fold_in(key, _DENSITY), (), len(SHAPES))
    counts = jnp.asarray(list(SHAPES.values()))[kind]
    wanted = [jnp.arange(capacity) < counts[number] for number, capacity in enumerate(most)]
    return jnp.concatenate(wanted), jnp.asarray([HALF_WIDTHS[name] for name in SHAPES])[kind]


@partial(jax.jit, static_argnums=0)
def random_pool(density: str, keys: Array) -> Scene:
    """Returns a pool of random worlds, one for each of `keys` [P]."""
    return jax.vmap(partial(random_scene, density))(keys)


def _place(reach: Array, draw: Array, wanted: Array) -> tuple[Array, Array, Array]:
    """Returns positions for discs that are `GAP` apart and `GAP` inside the volume, chosen one after the other.

    Args:
        reach: [N] radii, metres.
        draw: [N, K, 2] uniform in [0, 1), K candidate positions for each.
        wanted: [N] bool, which discs are to be placed.

    Returns:
        x, y: [N] metres. placed: [N] bool; a disc for which no candidate was free is not.
    """
    count = reach.shape[0]
    lower = jnp.broadcast_to(GAP + reach[:, None, None], (count, 1, 2))
    upper = jnp.array(SIZE[:2])[None, None] - lower
    candidates = lower + draw * (upper - lower)

    def place(discs: tuple[Array, Array, Array], item: tuple[Array, Array, Array, Array]):
        x, y, taken = discs
        number, radius, places, wanted = item
        apart = jnp.hypot(places[:, 0, None] - x[None], places[:, 1, None] - y[None])
        free = jnp.all(apart >= radius + taken[None] + GAP, axis=1)
        chosen = places[jnp.argmax(free)]
        found = jnp.any(free) & wanted
        # A disc without a free position is parked.
        x = x.at[number].set(jnp.where(found, chosen[0], PARKED))
        y = y.at[number].set(jnp.where(found, chosen[1], PARKED))
        return (x, y, taken.at[number].set(radius)), found

    parked = jnp.full(count, PARKED)
    discs = jnp.arange(count), reach, candidates, wanted
    (x, y, _), placed = jax.lax.scan(place, (parked, parked, jnp.zeros(count)), discs)
    return x, y, placed


def _colours(draw: Array) -> Array:
    """Returns albedos [N, 3] from uniform draws [N, 5]: greys of all values, about half of them with a tint."""
    grey = 0.15 + 0.7 * draw[:, :1]
    tint = 0.5 * draw[:, 1:4] - 0.25
    return jnp.clip(grey + jnp.where(draw[:, 4:] < 0.5, tint, 0.0), 0.05, 0.95)


# ------------------------------------------------------------------------------------- free points


def free_point(
    scene: Scene,
    key: Array,
    *,
    clearance: float = CLEARANCE,
    altitudes: tuple[float, float] | None = None,
    away_from: Array | None = None,
    distance: float = 0.0,
) -> Array:
    """Returns a random free point of the flight volume, uniform up to the conditions.

    It is the first of `_TRIES` uniform candidates that meets the conditions; if none does, the one that violates
    them least.

    Args:
        scene: one world.
        key: consumed.
        clearance: metres to the nearest surface, at least.
        altitudes: lowest and highest z, metres; None is the full height of the volume.
        away_from: [3] metres, a point to keep a distance from.
        distance: least distance to it, metres.

    Returns:
        [3] metres.
    """
    points = _scatter(scene, jax.random.uniform(key, (_TRIES, 3)), altitudes)
    return _first_free(scene, points, clearance, away_from, distance)


def start_goal(
    scene: Scene,
    key: Array,
    *,
    clearance: float = CLEARANCE,
    distance: float = FAR,
    altitudes: tuple[float, float] | None = _ALTITUDES,
) -> tuple[Array, Array]:
    """Returns a random free start and goal, each [3], at least `distance` metres apart, as in `free_point`."""
    draw = jax.random.uniform(key, (2, _TRIES, 3))
    return _far_apart(scene, draw, clearance=clearance, distance=distance, altitudes=altitudes)


def _far_apart(
    scene: Scene,
    draw: Array,
    *,
    clearance: float = CLEARANCE,
    distance: float = FAR,
    altitudes: tuple[float, float] | None = _ALTITUDES,
) -> tuple[Array, Array]:
    start = _first_free(scene, _scatter(scene, draw[0], altitudes), clearance)
    goal = _first_free(scene, _scatter(scene, draw[1], altitudes), clearance, start, distance)
    return start, goal


def _scatter(scene: Scene, draw: Array, altitudes: tuple[float, float] | None = None) -> Array:
    """Returns points [K, 3] of the flight volume, a margin inside its faces, from uniform draws [K, 3]."""
    lower, upper = fenced(scene)
    if altitudes is not None:
        lower = lower.at[2].max(altitudes[0])
        upper = upper.at[2].min(altitudes[1])
    return lower[None] + draw * (upper - lower)[None]


def fenced(scene: Scene) -> tuple[Array, Array]:
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
    lower, upper = map(np.asarray, fenced(scene))
    middles = corner + edge_m * every
    inside = np.all((middles >= lower) & (middles <= upper), axis=1)
    return Cells(
        is_one=jnp.asarray(is_one),
        chosen=jnp.asarray(every[inside] if inside.any() else every, jnp.int32),
        corner=jnp.asarray(corner, jnp.float32),
        edge_m=jnp.float32(edge_m),
    )


def _in_cells(cells: Cells, draw: Array) -> Array:
    """Returns points [K, 3] uniform over the cells, from uniform draws [K, 3]."""
    count = cells.chosen.shape[0]
    chosen = jnp.minimum((draw[:, 0] * count).astype(jnp.int32), count - 1)
    # The last digits of a number are as good as another one.
    within = jnp.stack([draw[:, 1], (1024.0 * draw[:, 1]) % 1.0, draw[:, 2]], axis=1) - 0.5
    return cells.corner[None] + cells.edge_m * (cells.chosen[chosen] + within)


def _is_in(cells: Cells, point: Array) -> Array:
    """Returns whether a point [3] lies in one of the cells."""
    at = jnp.round((point - cells.corner) / cells.edge_m).astype(jnp.int32)
    inside = jnp.all((at >= 0) & (at < jnp.array(cells.is_one.shape)))
    x, y, z = jnp.clip(at, 0, jnp.array(cells.is_one.shape) - 1)
    return inside & cells.is_one[x, y, z]


def _first_free(
    scene: Scene, points: Array, clearance: float, away_from: Array | None = None, distance: float = 0.0
) -> Array:
    """Returns the first of `points` [K, 3] that meets the conditions, or the one that violates them least."""
    short = jnp.minimum(jax.vmap(partial(signed_distance, scene))(points) - clearance, 0.0)
    if away_from is not None:
        apart = jnp.sqrt(jnp.sum((points - away_from[None]) ** 2, axis=1))
        short += jnp.minimum(apart - distance, 0.0)
    return points[jnp.argmax(short)]


# ---------------------------------------------------------------------------------------- missions


@struct.dataclass
class Missions:
    """M missions: in which world, from where, to where."""

    scene: Array  # [M] int32, index into the pool of worlds
    start: Array  # [M, 3] metres
    goal: Array  # [M, 3] metres


def own_missions(pool: Scene) -> Missions:
    """Returns one mission for each world of the pool [P]: from its own start to its own goal."""
    return Missions(scene=jnp.arange(pool.start.shape[0]), start=pool.start, goal=pool.goal)


@partial(jax.jit, static_argnums=1)
def random_missions(pool: Scene, count: int, key: Array) -> Missions:
    """Returns missions in random worlds of the pool between random free points at least `FAR` metres apart."""

    def mission(index: Array, draw: Array) -> Missions:
        start, goal = _far_apart(take_scene(pool, index), draw)
        return Missions(scene=index, start=start, goal=goal)

    scene_key, points_key = jax.random.split(key)
    index = jax.random.randint(scene_key, (count,), 0, pool.start.shape[0])
    return jax.vmap(mission)(index, jax.random.uniform(points_key, (count, 2, _TRIES, 3)))


@struct.dataclass
class Cells:
    """Cubes of a grid that starts are drawn from."""

    is_one: Array  # [X, Y, Z] bool, which cubes of the grid
    chosen: Array  # [K, 3] int32, those of them that points all over are drawn from
    corner: Array  # [3] metres, middle of the grid's first cube
    edge_m: Array  # [] metres


@partial(jax.jit, static_argnums=1)
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

    def mission(own: Array, index: Array, draw: Array) -> Missions:
        scene = take_scene(pool, index)
        points = _scatter(scene, draw[0]) if cells is None else _in_cells(cells, draw[0])
        anywhere = _first_free(scene, points, CLEARANCE, scene.goal, AWAY)
        lower = jnp.minimum(scene.volume[0] + 0.5, scene.start)
        upper = jnp.maximum(scene.volume[1] - 0.5, scene.start)
        # The start itself comes last: it is chosen if no other candidate is free.
        shift = (jnp.asarray(jitter) * (2.0 * draw[1] - 1.0)).at[-1].set(0.0)
        near = jnp.clip(scene.start[None] + shift, lower[None], upper[None])
        if cells is not None:
            near = jnp.where(jax.vmap(partial(_is_in, cells))(near)[:, None], near, scene.start)
        start = jnp.where(own, _first_free(scene, near, CLEARANCE), anywhere)
        return Missions(scene=index, start=start, goal=scene.goal)

    order_key, scene_key, points_key = jax.random.split(key, 3)
    own = jax.random.permutation(order_key, jnp.arange(count) < jnp.round(own_start_fraction * count))
    index = jax.random.randint(scene_key, (count,), 0, pool.start.shape[0])
    return jax.vmap(mission)(own, index, jax.random.uniform(points_key, (count, 2, _TRIES, 3)))
