"""Worlds with any number of boxes, for questions in which nothing but their number may change."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.sim.scene import Planes, Scene, UprightBoxes, build_scene
from edqn_jax.sim.worlds import GROUND_RGB, SIZE

CELL = 10.0
"""Metres of a square cell of the ground; a cell holds one box at most."""
REACH = 4.0
"""Metres around a cell's middle that a box stays within, so that there is a way between any two."""
MOST = int(SIZE[0] // CELL) * int(SIZE[1] // CELL)
"""Boxes that there is a cell for."""
_CORNER = np.array([1.0, 1.0, 3.0])  # of the start, and how far the goal is from the opposite corner


def world_of_boxes(count: int) -> Scene:
    """`count` upright boxes over level ground in the volume of random worlds, on the way from corner to corner.

    A world of fewer boxes has the first ones of a world of more.

    Raises:
        ValueError: if there is no cell for so many.
    """
    if not 0 <= count <= MOST:
        raise ValueError(f"a world holds from 0 to {MOST} boxes, not {count}")
    columns = int(SIZE[0] // CELL)
    draw = np.random.default_rng(0)
    cells = draw.permutation(MOST)[:count]
    # Drawn for every cell, so that a box does not depend on how many there are.
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
