"""Ellipsoids and height fields of MuJoCo as closed meshes."""

from __future__ import annotations

from functools import lru_cache

import mujoco
import numpy as np

_DIVISIONS = 4  # of an icosahedron: at most 0.03 % of the radius is missing between its corners

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices [V, 3], metres, and triangles [F, 3] anticlockwise from outside."""


@lru_cache(maxsize=1)
def _ball() -> Mesh:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=_DIVISIONS)
    return np.asarray(ball.vertices), np.asarray(ball.faces, np.int64)


def ellipsoid_mesh(size: tuple[float, float, float]) -> Mesh:
    """Returns an ellipsoid of half axes `size`, metres."""
    vertices, faces = _ball()
    return vertices * np.asarray(size), faces


def field_mesh(model: mujoco.MjModel, number: int) -> Mesh:
    """Returns height field `number` of a model as a solid: its surface, four sides and a level bottom."""
    rows, columns = int(model.hfield_nrow[number]), int(model.hfield_ncol[number])
    x_half, y_half, top, below = model.hfield_size[number]
    begin = model.hfield_adr[number]
    heights = top * model.hfield_data[begin : begin + rows * columns].reshape(rows, columns)
    y, x = np.meshgrid(np.linspace(-y_half, y_half, rows), np.linspace(-x_half, x_half, columns), indexing="ij")
    surface = np.stack([x, y, heights], axis=-1).reshape(-1, 3)
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
    faces = np.concatenate([np.stack(each, axis=-1).reshape(-1, 3) for each in ((a, b, c), (a, c, d))])
    rim = np.concatenate([at[0, :-1], at[:-1, -1], at[-1, :0:-1], at[:0:-1, 0]])  # anticlockwise from above
    lower = len(surface) + np.arange(len(rim))
    after = np.roll(rim, -1), np.roll(lower, -1)
    sides = np.concatenate([np.stack([rim, lower, after[1]], 1), np.stack([rim, after[1], after[0]], 1)])
    middle = np.full(len(rim), len(surface) + len(rim))
    bottom = np.stack([middle, after[1], lower], axis=1)
    floor = surface[rim] * [1, 1, 0] - [0, 0, below]
    return np.concatenate([surface, floor, [[0, 0, -below]]]), np.concatenate([faces, sides, bottom])
