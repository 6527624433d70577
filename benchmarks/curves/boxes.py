"""Worlds that differ only in their number of boxes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.sim.scene.scene import Planes, Scene, UprightBoxes, build_scene
from edqn_jax.sim.worlds.building import GROUND_RGB
from edqn_jax.sim.worlds.open_worlds import SIZE

CELL = 10.0
"""Size of a square cell of the ground, metres; a cell contains at most one box."""
REACH = 4.0
"""Metres around the centre of a cell within which its box stays, so that there is a gap between any two boxes."""
MOST = int(SIZE[0] // CELL) * int(SIZE[1] // CELL)
"""Maximum number of boxes: one for each cell."""
_CORNER = np.array([1.0, 1.0, 3.0])  # the start, and the distance of the goal from the opposite corner, metres


def world_of_boxes(count: int) -> Scene:
    """Returns a world of `count` upright boxes on level ground, with the volume of random worlds.

    Start and goal are in opposite corners. The boxes of a smaller world are the first ones of a larger world.

    Raises:
        ValueError: if there are fewer cells than boxes.
    """
    if not 0 <= count <= MOST:
        raise ValueError(f"a world has from 0 to {MOST} boxes, not {count}")
    columns = int(SIZE[0] // CELL)
    draw = np.random.default_rng(0)
    cells = draw.permutation(MOST)[:count]
    # Drawn for every cell, so that a box does not depend on their number.
    width, depth, height, yaw, shift, towards, grey = draw.random((7, MOST))[:, :count]
    half = np.stack([1.0 + 1.5 * width, 1.0 + 1.5 * depth, 2.0 + 10.0 * height], axis=1)
    away = shift * (REACH - np.hypot(half[:, 0], half[:, 1]))
    x = CELL * (cells % columns + 0.5) + away * np.cos(2 * np.pi * towards)
    y = CELL * (cells // columns + 0.5) + away * np.sin(2 * np.pi * towards)
    boxes = UprightBoxes(
        position=jnp.asarray(np.stack([x, y, half[:, 2]], axis=1)),
        half=jnp.asarray(half),
        yaw=jnp.asarray(np.pi * yaw),
        albedo=jnp.asarray(np.repeat(0.15 + 0.7 * grey[:, None], 3, axis=1)),
    )
    ground = Planes(position=jnp.zeros(3), normal=jnp.array([0.0, 0.0, 1.0]), albedo=jnp.array(GROUND_RGB))
    shapes = [ground, *(jax.tree.map(lambda leaf, i=i: leaf[i], boxes) for i in range(count))]
    goal = np.array([SIZE[0], SIZE[1], 2 * _CORNER[2]]) - _CORNER
    return build_scene(shapes, volume=[(0.0, 0.0, 0.0), SIZE], start=_CORNER, goal=goal)
