"""Open worlds, sparse, medium or dense: blocks, pillars and balls that a drone flies around or climbs over."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.worlds import building, discs
from edqn_jax.sim.worlds.free_points import TRIES

SIZE = (110.0, 110.0, 25.0)
"""Flight volume, metres: the paper's."""
SHAPES = {"sparse": (8, 2, 2), "medium": (22, 5, 3), "dense": (44, 10, 6)}
"""Blocks, pillars and balls, if all find a place. Medium is the paper's density."""
HALF_WIDTHS = {"sparse": (2.0, 5.5), "medium": (2.0, 5.5), "dense": (1.5, 4.0)}
"""Range of a block's half width and half depth, metres."""
GAP = 3.0
"""Free metres between the footprints of any two shapes, and between them and the faces of the volume."""


def body_slots(density: str) -> dict[str, tuple[int, ...]]:
    """Returns the bodies of the worlds of a density, as `moving` moves them: every shape is one."""
    blocks, pillars, balls = SHAPES[density]
    ends = {"boxes": blocks, "cylinders": blocks + pillars, "spheres": blocks + pillars + balls}
    counts = {"boxes": blocks, "cylinders": pillars, "spheres": balls}
    return {kind: tuple(range(ends[kind] - counts[kind], ends[kind])) for kind in ends}


def sample_open_world(density: str, key: Array) -> Scene:
    """Returns a random world: blocks, pillars and balls over level ground, a start and a goal.

    The free space is connected by construction, so there is always a path from start to goal. The
    footprints' bounding circles are `GAP` apart and `GAP` inside the volume; grown by the drone's radius
    (0.36 m) they are still disjoint discs inside the rectangle, and a rectangle without finitely many
    disjoint discs in its interior is connected. That holds at every altitude, since no shape is wider
    anywhere than its footprint. A point above or below a shape is no exception: moving level and straight
    away from the shape's middle, it comes no closer to that shape and reaches the rim of its disc before
    any other disc begins. So every free point is connected to the free space between the discs.

    Args:
        density: of `SHAPES`.
        key: consumed.
    """
    blocks, pillars, balls = SHAPES[density]
    count = blocks + pillars + balls
    # One draw for all: on CPU each separate draw costs half a second of compilation.
    draws = jax.random.uniform(key, (count * (4 + 2 * discs.PLACES + building.COLOUR_DRAWS) + 2 * TRIES * 3,))
    sizes, places, colours, ends = jnp.split(
        draws, [count * 4, count * (4 + 2 * discs.PLACES), count * (4 + 2 * discs.PLACES + building.COLOUR_DRAWS)]
    )
    size = sizes.reshape(count, 4)
    first, second = blocks, blocks + pillars
    sides = building.scale_uniforms(HALF_WIDTHS[density], size[:first, :2])
    block_height = 4.0 + 20.0 * size[:first, 2]
    pillar_radius, pillar_height = 0.5 + 1.5 * size[first:second, 0], 8.0 + 17.0 * size[first:second, 1]
    ball_radius = 1.5 + 2.5 * size[second:, 0]
    # From resting on the ground to hanging 2 m below the ceiling.
    ball_height = ball_radius + size[second:, 1] * (SIZE[2] - 2.0 - 2.0 * ball_radius)

    reach = jnp.concatenate([jnp.hypot(sides[:, 0], sides[:, 1]), pillar_radius, ball_radius])
    candidates = discs.candidates_inside(reach, places.reshape(count, discs.PLACES, 2), SIZE[:2], GAP)
    x, y, placed = discs.place_discs(reach, candidates, GAP)
    z = jnp.concatenate([block_height / 2, pillar_height / 2, ball_height])
    position = jnp.stack([x, y, z], axis=1)
    albedo = building.make_albedos(colours.reshape(count, -1))

    a, b, c = slice(first), slice(first, second), slice(second, None)
    half = jnp.column_stack([sides, block_height / 2])
    return building.build_scene(
        SIZE,
        ends.reshape(2, TRIES, 3),
        building.make_ground(),
        building.make_boxes(placed[a], position[a], half, jnp.pi * size[a, 3], albedo[a]),
        building.make_cylinders(placed[b], position[b], pillar_radius, pillar_height / 2, albedo[b]),
        building.make_spheres(placed[c], position[c], ball_radius, albedo[c]),
    )
