"""A grid of distances as boxes, for pictures, which draw convex solids; and meshes of fewer triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edqn_jax.sim.scene.mesh_field import Grid

MOST_BOXES = 800

_FILLED_M = 0.01  # a point this near to a solid is drawn

Integers = NDArray[np.int64]


def boxes_of_grid(grid: Grid) -> NDArray[np.float64]:
    """Returns boxes [B, 2, 3] that fill the inside of a grid: lower and upper corners, metres about its middle.

    They are at most `MOST_BOXES`, the coarser the more there would be.
    """
    filled = grid.values < _FILLED_M
    low = -grid.cell * (np.array(filled.shape) / 2)
    stride, boxes = 1, _merged_boxes(filled)
    while len(boxes) > MOST_BOXES:
        stride += 1
        boxes = _merged_boxes(_coarser(filled, stride))
    return np.clip(low + stride * grid.cell * boxes, -grid.half, grid.half)


def clustered(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], step: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns a mesh whose vertices in each cube of sides `step` are one."""
    _, first, number = np.unique(
        np.floor(vertices / step).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    rings = np.unique(np.sort(number.reshape(-1)[faces], axis=1), axis=0)
    rings = rings[(np.diff(rings, axis=1) > 0).all(1)]
    return vertices[first], rings


def thinned(vertices: NDArray[np.float64], faces: Integers, most: int) -> tuple[NDArray[np.float64], Integers]:
    """Returns a mesh [V, 3] of at most so many triangles [F, 3]: vertices in cubes are one, the smallest that do."""
    step = float(np.ptp(vertices, axis=0).max()) / 2000 if len(faces) > most else 0.0
    found = vertices, faces
    while len(found[1]) > most:
        found = clustered(vertices, faces, step)
        step *= 1.25
    return found


def _coarser(filled: NDArray[np.bool_], stride: int) -> NDArray[np.bool_]:
    """Returns which blocks of `stride` points along each axis have any that is filled."""
    for axis in range(3):
        moved = np.moveaxis(filled, axis, 0)
        filled = np.moveaxis(np.logical_or.reduceat(moved, np.arange(0, len(moved), stride)), 0, axis)
    return filled


def _merged_boxes(filled: NDArray[np.bool_]) -> Integers:
    """Returns the filled places as boxes [B, 2, 3], the first place of each and that after its last."""
    places = np.argwhere(filled)
    rows = np.concatenate([places, places + 1], axis=1)
    for axis in (2, 1, 0):
        rest = [column for column in range(6) if column % 3 != axis]
        rows = rows[np.lexsort([rows[:, axis], *(rows[:, column] for column in rest)])]
        joins = (rows[1:, axis] == rows[:-1, axis + 3]) & (rows[1:, rest] == rows[:-1, rest]).all(1)
        first = np.flatnonzero(np.concatenate([[True], ~joins])) if len(rows) else np.zeros(0, int)
        last = np.concatenate([first[1:] - 1, [len(rows) - 1]]) if len(rows) else first
        merged = rows[first].copy()
        merged[:, axis + 3] = rows[last, axis + 3]
        rows = merged
    return rows.reshape(-1, 2, 3)
