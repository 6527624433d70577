"""Random worlds and their seeds."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from edqn_jax.config import DENSITIES
from edqn_jax.errors import ConfigError
from edqn_jax.random import integers
from edqn_jax.sim.free_points import TRIES, far_apart
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
GROUND_RGB = (0.37, 0.43, 0.35)
"""Albedo of the ground."""

_DENSITY = 1_000_003  # folded into the key of a mixed world to draw its density
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
    draws = jax.random.uniform(key, (count * (4 + 2 * _PLACES + 5) + 2 * TRIES * 3,))
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
    start, goal = far_apart(scene, ends.reshape(2, TRIES, 3))
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
