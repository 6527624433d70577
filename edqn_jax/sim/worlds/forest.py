"""Forests: thin trunks from floor to canopy, some with a branch."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from edqn_jax.keys import uniform_parts
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.worlds import building, discs
from edqn_jax.sim.worlds.free_points import TRIES

SIZE = (40.0, 40.0, 9.0)
"""Flight volume, metres. It ends at the canopy, which the trunks reach: nobody climbs over them."""
TREES, WITH_BRANCH = 104, 56
"""Trees, if all find a place, and how many of them, the first ones, have a branch."""
GAP = 1.6
"""Free metres between any two trees at least; from trunk to trunk it is 2.6 m to the next one (median)."""
TRUNK_RADIUS = (0.12, 0.4)
BRANCH_LENGTH = (0.5, 1.2)
"""From the trunk's axis, metres."""
BRANCH_HALF_WIDTH = 0.09

_EDGE = 1.0  # metres around a corner of the floor that no tree closes
_OF_A_TREE = 5

BODIES = {"cylinders": tuple(range(TREES)), "boxes": tuple(range(WITH_BRANCH))}
"""Bodies, as `moving` moves them: trunk and branch are one."""


def sample_forest(key: Array) -> Scene:
    """Returns a random forest, a start and a goal.

    The free space is connected by construction. A tree is a disc seen from above, and the discs, grown by the drone's
    radius, are still apart. A disc may reach over one side of the floor, but closes no corner: discs and outside have
    no loop between them, so they do not divide the floor. Beside a branch the space is open to both sides, above and
    below.

    Args:
        key: consumed.
    """
    shapes = TREES + WITH_BRANCH
    counts = (TREES * _OF_A_TREE, TREES * 2 * discs.PLACES, shapes * building.COLOUR_DRAWS, 2 * TRIES * 3)
    sizes, places, colours, ends = uniform_parts(key, counts)
    size = sizes.reshape(TREES, _OF_A_TREE)
    trunk = building.scale_uniforms(TRUNK_RADIUS, size[:, 0])
    length = building.scale_uniforms(BRANCH_LENGTH, size[:WITH_BRANCH, 1])
    yaw, height = 2 * jnp.pi * size[:WITH_BRANCH, 2], 1.0 + (SIZE[2] - 2.0) * size[:WITH_BRANCH, 3]
    tip = jnp.hypot(length, BRANCH_HALF_WIDTH)
    reach = trunk.at[:WITH_BRANCH].max(tip)
    candidates = discs.across_the_edge(reach, places.reshape(TREES, discs.PLACES, 2), SIZE[:2], _EDGE)
    x, y, placed = discs.place_discs(reach, candidates, GAP)
    albedo = building.make_albedos(colours.reshape(shapes, -1))

    standing = jnp.stack([x, y, jnp.full(TREES, SIZE[2] / 2)], axis=1)
    middle = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=1) * length[:, None] / 2
    branch = jnp.column_stack([standing[:WITH_BRANCH, :2] + middle, height])
    half = jnp.stack([length / 2, *2 * [jnp.full(WITH_BRANCH, BRANCH_HALF_WIDTH)]], axis=1)
    return building.build_scene(
        SIZE,
        ends.reshape(2, TRIES, 3),
        building.make_ground(),
        building.make_boxes(placed[:WITH_BRANCH], branch, half, yaw, albedo[TREES:]),
        building.make_cylinders(placed, standing, trunk, SIZE[2] / 2, albedo[:TREES]),
    )
