"""Distances to a scene compiled with numba, for planners that query one point or one segment at a time.

The call of a jitted JAX function takes longer than the distances of a small scene. Here a scene is one table with a row
for each shape, and the shapes of `sim.scene` are reduced to four kinds with any rotation: box, cylinder, capsule (a
sphere is a capsule of length 0) and plane.
"""

from __future__ import annotations

import math

import numpy as np

from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.sim.scene.scene import (
    PARKED,
    Capsules,
    Planes,
    Scene,
    Shape,
    Spheres,
    TiltedBoxes,
    TiltedCylinders,
    UprightBoxes,
    UprightCylinders,
    scene_shapes,
)

numba = require_extra("numba")

_BOX, _CYLINDER, _CAPSULE, _PLANE = range(4)
_STRIDE = 0.02  # metres; undetected penetration of at most 0.01^2 / 2 r = 0.14 mm
_UP = np.array([0.0, 0.0, 1.0])


def solid_table(scene: Scene) -> np.ndarray:
    """Returns the shapes of one world as a table [N, 17] float64.

    Columns: kind, radius of the bounding sphere, centre [3], sizes [3], axes [9]. Sizes are the half extents of a box,
    or half length and radius of a cylinder or capsule. Axes are the three of a box; for other shapes the first is the
    direction, for a plane the normal, and the others are 0.
    """
    return np.array([_row(shape) for shape in scene_shapes(scene)], np.float64).reshape(-1, 17)


def _row(shape: Shape) -> np.ndarray:
    sizes, axes = np.zeros(3), np.zeros((3, 3))
    match shape:
        case UprightBoxes():
            c, s = math.cos(float(shape.yaw)), math.sin(float(shape.yaw))
            kind, sizes, axes = _BOX, shape.half, np.array([(c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)])
        case TiltedBoxes():
            kind, sizes, axes = _BOX, shape.half, np.asarray(shape.rotation).T
        case UprightCylinders():
            kind, axes[0] = _CYLINDER, _UP
            sizes[:2] = shape.half_height, shape.radius
        case TiltedCylinders():
            kind, axes[0] = _CYLINDER, shape.axis
            sizes[:2] = shape.half_length, shape.radius
        case Spheres():
            kind, axes[0], sizes[1] = _CAPSULE, _UP, shape.radius
        case Capsules():
            kind, axes[0] = _CAPSULE, shape.axis
            sizes[:2] = shape.half_length, shape.radius
        case Planes():
            kind, axes[0] = _PLANE, shape.normal
        case _:
            raise ConfigError(f"planners know the package's own kinds of shape alone, not {type(shape).__name__}")
    reach = {_PLANE: math.inf, _CAPSULE: float(np.sum(sizes))}.get(kind, float(np.linalg.norm(sizes)))
    return np.concatenate([[kind, reach], np.asarray(shape.position), sizes, axes.ravel()])


@numba.njit
def shape_distance(row, x, y, z):
    """Returns the signed distance in metres from a point to the shape of one row [17] of the table."""
    dx, dy, dz = x - row[2], y - row[3], z - row[4]
    along = dx * row[8] + dy * row[9] + dz * row[10]
    if row[0] == _PLANE:
        return along
    if row[0] == _CAPSULE:
        along = min(max(along, -row[5]), row[5])
        return math.sqrt((dx - along * row[8]) ** 2 + (dy - along * row[9]) ** 2 + (dz - along * row[10]) ** 2) - row[6]
    if row[0] == _BOX:
        a = abs(along) - row[5]
        b = abs(dx * row[11] + dy * row[12] + dz * row[13]) - row[6]
        c = abs(dx * row[14] + dy * row[15] + dz * row[16]) - row[7]
    else:
        a = abs(along) - row[5]
        b = math.sqrt((dx - along * row[8]) ** 2 + (dy - along * row[9]) ** 2 + (dz - along * row[10]) ** 2) - row[6]
        c = -math.inf
    deepest = max(a, b, c)
    if deepest <= 0.0:
        return deepest
    return math.sqrt(max(a, 0.0) ** 2 + max(b, 0.0) ** 2 + max(c, 0.0) ** 2)


@numba.njit
def distance(table, x, y, z):
    """Returns metres from a point to the nearest surface, negative inside a shape: `sim.distance.signed_distance`."""
    nearest = PARKED
    for i in range(table.shape[0]):
        row = table[i]
        within = nearest + row[1]
        # The bounding sphere of a shape is no further away than the shape.
        if within > 0.0 and (x - row[2]) ** 2 + (y - row[3]) ** 2 + (z - row[4]) ** 2 >= within**2:
            continue
        nearest = min(nearest, shape_distance(row, x, y, z))
    return nearest


@numba.njit
def leg_free(table, start, end, radius):
    """Returns whether a sphere passes straight from `start` [3] to `end` [3], by steps as long as the clearance."""
    length = math.sqrt((end[0] - start[0]) ** 2 + (end[1] - start[1]) ** 2 + (end[2] - start[2]) ** 2)
    along = 0.0
    while True:
        share = along / length if length > 0.0 else 0.0
        x = start[0] + share * (end[0] - start[0])
        y = start[1] + share * (end[1] - start[1])
        z = start[2] + share * (end[2] - start[2])
        gap = distance(table, x, y, z) - radius
        if not gap >= 0.0:
            return False
        if along >= length:
            return True
        along = min(along + max(gap, _STRIDE), length)
