"""Canyons: courtyards, overhangs, slabs and towers between which a drone finds its way; most reach to the top."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from edqn_jax.keys import uniform_parts
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.worlds import building, discs
from edqn_jax.sim.worlds.free_points import TRIES

SIZE = (60.0, 60.0, 12.0)
"""Flight volume, metres."""
LARGE, SMALL = 10, 22
"""Buildings, if all find a place; the large ones are placed first."""
REACHES = (4.5, 6.5), (2.2, 4.0)
"""Radius of the disc that a large and a small building stands in, metres."""
GAP = 2.4
"""Free metres between any two of these discs."""
WALL = 0.8
"""Thickness of walls, metres."""
SLAB = 0.6
"""Thickness of roofs and shelves, metres."""
SHELF_HEIGHT = (3.0, 8.0)
"""Of roofs and shelves, metres."""
STANDING, HANGING = (4.0, 8.0), (3.5, 7.0)
"""How high a standing slab reaches, and how far down a hanging one, metres."""

_EDGE = 2.0  # metres around a corner of the floor that no building closes
_PARTS = 4  # of a large building at most; a small one is no courtyard and has half as many
_OF_A_BUILDING = 4

BODIES = {
    "boxes": tuple(b for b in range(LARGE + SMALL) for _ in range(_PARTS if b < LARGE else _PARTS // 2)),
}
"""Bodies, as `moving` moves them: all parts of a building are one."""


def sample_canyon(key: Array) -> Scene:
    """Returns a random canyon, a start and a goal.

    The free space is connected by construction, as that of a forest: each building stands in a disc, the discs are
    apart and close no corner. From anywhere in a building's disc there is a way to its rim: courtyards have an open
    side, below and above a shelf and between two slabs the space is open to at least one side.

    Args:
        key: consumed.
    """
    buildings, parts = LARGE + SMALL, LARGE * _PARTS + SMALL * _PARTS // 2
    counts = (buildings * _OF_A_BUILDING, buildings * 2 * discs.PLACES, parts * building.COLOUR_DRAWS, 2 * TRIES * 3)
    plans, places, colours, ends = uniform_parts(key, counts)
    plan = plans.reshape(buildings, _OF_A_BUILDING)
    is_large = jnp.arange(buildings) < LARGE
    narrow, wide = (jnp.where(is_large, large, small) for large, small in zip(*REACHES, strict=True))
    reach = building.scale_uniforms((narrow, wide), plan[:, 0])
    candidates = discs.across_the_edge(reach, places.reshape(buildings, discs.PLACES, 2), SIZE[:2], _EDGE)
    x, y, placed = discs.place_discs(reach, candidates, GAP)
    low, high, there = jax.vmap(_parts)(reach, plan[:, 1], plan[:, 2], is_large)

    # A building that reaches over the edge opens towards the middle: what opens outwards would be closed.
    to_edge = jnp.minimum(jnp.minimum(x, SIZE[0] - x), jnp.minimum(y, SIZE[1] - y))
    inwards = jnp.arctan2(y - SIZE[1] / 2, x - SIZE[0] / 2)
    yaw = jnp.where(to_edge < reach, inwards, 2 * jnp.pi * plan[:, 3])
    cos, sin = jnp.cos(yaw)[:, None], jnp.sin(yaw)[:, None]
    middle = (low + high) / 2
    turned = jnp.stack(
        [
            x[:, None] + cos * middle[..., 0] - sin * middle[..., 1],
            y[:, None] + sin * middle[..., 0] + cos * middle[..., 1],
            middle[..., 2],
        ],
        axis=-1,
    )
    # Of small buildings the last parts, which they never have, are left out.
    kept = jnp.flatnonzero(is_large[:, None] | (jnp.arange(_PARTS) < _PARTS // 2)[None], size=parts)
    return building.build_scene(
        SIZE,
        ends.reshape(2, TRIES, 3),
        building.make_ground(),
        building.make_boxes(
            (there & placed[:, None]).reshape(-1)[kept],
            turned.reshape(-1, 3)[kept],
            ((high - low) / 2).reshape(-1, 3)[kept],
            jnp.repeat(yaw, _PARTS)[kept],
            building.make_albedos(colours.reshape(parts, -1)),
        ),
    )


def _parts(reach: Array, kind: Array, level: Array, is_large: Array) -> tuple[Array, Array, Array]:
    """Returns the parts of a building that faces -x, in a disc around the origin.

    Args:
        reach: [] metres.
        kind: [] uniform in [0, 1): tower, wall with a shelf, standing and hanging slab, courtyard.
        level: [] uniform in [0, 1): of what varies in height.
        is_large: [] bool, whether it may be a courtyard.

    Returns:
        low, high: [4, 3] metres. there: [4] bool.
    """
    top, w = SIZE[2], WALL
    side = 0.7 * reach  # of the largest square, from the middle
    shelf, standing, hanging = (building.scale_uniforms(span, level) for span in (SHELF_HEIGHT, STANDING, HANGING))
    courtyard = (
        ((side - w, -side, 0.0), (side, side, top)),
        ((-side, side - w, 0.0), (side, side, top)),
        ((-side, -side, 0.0), (side, w - side, top)),
        ((0.0, -side, shelf), (side, side, shelf + SLAB)),
    )
    overhang = (
        ((0.0, -0.9 * reach, 0.0), (w, 0.9 * reach, top)),
        ((-0.6 * reach, -0.7 * reach, shelf), (0.0, 0.7 * reach, shelf + SLAB)),
    )
    slabs = (
        ((-0.3 * reach - w, -0.74 * reach, 0.0), (-0.3 * reach, 0.74 * reach, standing)),
        ((0.3 * reach, -0.74 * reach, hanging), (0.3 * reach + w, 0.74 * reach, top)),
    )
    tower = (((-0.6 * reach, -0.6 * reach, 0.0), (0.6 * reach, 0.6 * reach, top)),)
    nothing = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    kinds = [(*parts, *[nothing] * (_PARTS - len(parts))) for parts in (tower, overhang, slabs, courtyard)]
    corners = jnp.stack([_stack_corners(parts) for parts in kinds])
    kinds_of_it = jnp.where(is_large, 4, 3)
    number = jnp.minimum((kind * kinds_of_it).astype(jnp.int32), kinds_of_it - 1)
    chosen = corners[number]
    there = jnp.arange(_PARTS) < jnp.array([1, 2, 2, 4])[number]
    return chosen[:, 0], chosen[:, 1], there


def _stack_corners(parts) -> Array:
    """Returns corners [4, 2, 3] from nested tuples of numbers."""
    return jnp.stack([jnp.stack([jnp.stack([jnp.asarray(x, jnp.float32) for x in c]) for c in part]) for part in parts])
