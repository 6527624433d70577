"""The shapes of a world, and where a level camera meets them: what `columns.py` and `depths.py` share.

H rows, W columns. Heights and intervals of rows are counted from the horizon, positive upwards.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from conventional_stack.cameras.optics import heading_of
from conventional_stack.world import Geoms
from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.sim.camera.coverage import FAR_U, NEAR_M
from edqn_jax.sim.scene.shapes.kind import TINY

numba = require_extra("numba")

_FAST = {"reassoc", "nsz", "arcp", "contract"}
"""Liberties of the compiler with products and sums; numbers that are not finite keep their meaning."""

compiled = numba.njit(cache=True, error_model="numpy", fastmath=_FAST)
inlined = numba.njit(cache=True, error_model="numpy", fastmath=_FAST, forceinline=True)
"""Of functions that are called for each column or pixel: a tuple of arrays is a slow argument."""


class Shapes(NamedTuple):
    """N upright boxes and cylinders, S spheres and L planes."""

    is_round: NDArray[np.bool_]  # [N] whether it is a cylinder
    place: NDArray[np.float64]  # [N, 3] metres
    turn: NDArray[np.float64]  # [N, 2] cosine and sine of yaw
    half: NDArray[np.float64]  # [N, 3] metres; of a cylinder radius, radius, half height
    luma: NDArray[np.float64]  # [N]
    ball: NDArray[np.float64]  # [S, 3] metres
    radius: NDArray[np.float64]  # [S] metres
    ball_luma: NDArray[np.float64]  # [S]
    plane: NDArray[np.float64]  # [L, 3] a point of it, metres
    normal: NDArray[np.float64]  # [L, 3] unit
    plane_luma: NDArray[np.float64]  # [L]


def shapes_of(geoms: Geoms) -> Shapes:
    """Returns the geoms of a world by what they are to this camera.

    Raises:
        ConfigError: if one is neither an upright box or cylinder nor a sphere or plane.
    """
    types = mujoco.mjtGeom
    box, cylinder, sphere, plane = (
        geoms.kind == int(kind)
        for kind in (types.mjGEOM_BOX, types.mjGEOM_CYLINDER, types.mjGEOM_SPHERE, types.mjGEOM_PLANE)
    )
    upright = (box | cylinder) & (np.abs(geoms.axes[:, 2, 2]) > 1 - 1e-9)
    if not np.all(upright | sphere | plane):
        raise ConfigError(
            "the conventional stack's camera by columns supports only upright boxes and cylinders, spheres and planes; "
            "its camera by rays supports every shape"
        )
    half = geoms.size[upright].copy()
    standing = cylinder[upright]
    half[standing] = half[standing][:, [0, 0, 1]]
    return Shapes(
        is_round=standing,
        place=geoms.position[upright],
        turn=np.ascontiguousarray(geoms.axes[upright, 0, :2]),
        half=half,
        luma=geoms.luma[upright],
        ball=geoms.position[sphere],
        radius=np.ascontiguousarray(geoms.size[sphere, 0]),
        ball_luma=geoms.luma[sphere],
        plane=geoms.position[plane],
        normal=np.ascontiguousarray(geoms.axes[plane, 2]),
        plane_luma=geoms.luma[plane],
    )


@inlined
def inverse(x):
    return 1.0 / (x if abs(x) >= TINY else TINY)


@inlined
def lit(light, nx, ny, nz):
    """Returns the Lambert shade of a unit normal; `light` is the ambient share and the sun's direction."""
    ambient, sx, sy, sz = light
    return ambient + (1.0 - ambient) * max(nx * sx + ny * sy + nz * sz, 0.0)


@inlined
def out_of_sight(optics, cos, sin, x, y, radius):
    """Returns whether nothing within `radius` of (x, y), relative to the eye, can be in the image."""
    ahead, right = x * cos + y * sin, x * sin - y * cos
    edge = 0.5 * optics.pitch * len(optics.u)
    reach = 1.0001 * radius + 1e-3
    aslant = reach * math.sqrt(1.0 + edge * edge)
    return ahead + reach < NEAR_M or right - edge * ahead > aslant or -right - edge * ahead > aslant


@inlined
def extent_of_box(cos, sin, x, y, turn_x, turn_y, hx, hy):
    """Returns the least and greatest image-plane coordinate of a box at (x, y) relative to the eye."""
    low, high = math.inf, -math.inf
    cx, cy = x + turn_x * hx + turn_y * hy, y + turn_y * hx - turn_x * hy
    ahead, right = cx * cos + cy * sin, cx * sin - cy * cos
    for corner in range(4):
        sx, sy = (1.0 if corner in (0, 3) else -1.0), (1.0 if corner < 2 else -1.0)
        cx, cy = x + turn_x * sx * hx - turn_y * sy * hy, y + turn_y * sx * hx + turn_x * sy * hy
        before_ahead, before_right = ahead, right
        ahead, right = cx * cos + cy * sin, cx * sin - cy * cos
        if ahead >= NEAR_M:
            low, high = min(low, right / ahead), max(high, right / ahead)
        if (ahead < NEAR_M) != (before_ahead < NEAR_M):
            part = (NEAR_M - before_ahead) * inverse(ahead - before_ahead)
            u = (before_right + part * (right - before_right)) / NEAR_M
            low, high = min(low, u), max(high, u)
    return low, high


@inlined
def extent_of_disc(cos, sin, x, y, radius):
    """Returns the same of a disc, from its two tangents through the eye."""
    ahead, right = x * cos + y * sin, x * sin - y * cos
    if ahead + radius <= 0:
        return math.inf, -math.inf
    distance = math.sqrt(ahead * ahead + right * right)
    sine = min(radius / max(distance, TINY), 1.0)
    cosine = math.sqrt(1.0 - sine * sine)
    low, high = -FAR_U, FAR_U
    closest = NEAR_M * 1e-3
    if distance > radius:
        if ahead * cosine + right * sine > closest:
            low = (right * cosine - ahead * sine) / (ahead * cosine + right * sine)
        if ahead * cosine - right * sine > closest:
            high = (right * cosine + ahead * sine) / (ahead * cosine - right * sine)
    return low, high


@inlined
def columns_between(optics, low, high):
    """Returns the columns [first, last) that an interval of the image plane may touch."""
    width, pitch = len(optics.u), optics.pitch
    first = min(max((low - optics.u[0]) / pitch - 1.0, 0.0), float(width))
    last = min(max((high - optics.u[0]) / pitch + 2.0, 0.0), float(width))
    return int(first), int(last)


@inlined
def rows_between(height, low, high):
    """Returns the rows [first, last) of the image that an interval of heights in rows may touch."""
    first = min(max(0.5 * height - high - 1.0, 0.0), float(height))
    last = min(max(0.5 * height - low + 1.0, 0.0), float(height))
    return int(first), int(last)


@inlined
def slabs(x, y, fx, fy, hx, hy, u):
    """Returns both reciprocal slopes, and the depths at which the ray at `u` enters and leaves both pairs of sides.

    Args:
        x, y: the eye from the box's axis, in the box's frame.
        fx, fy: the optical axis in that frame.
    """
    ix, iy = inverse(fx + u * fy), inverse(fy - u * fx)
    reach_x, reach_y = hx * abs(ix), hy * abs(iy)
    return ix, iy, -x * ix - reach_x, -y * iy - reach_y, -x * ix + reach_x, -y * iy + reach_y


@inlined
def in_frame(turn_x, turn_y, x, y):
    """Returns the vector (x, y) of the world in the frame of a box."""
    return turn_x * x + turn_y * y, turn_x * y - turn_y * x


@inlined
def past_ball(ox, oy, oz, dx, dy, dz):
    """Returns depth and distance at which a ray from (ox, oy, oz) passes a ball's middle, and its squared length."""
    a = dx * dx + dy * dy + dz * dz
    middle = -(ox * dx + oy * dy + oz * dz) / a
    return middle, math.sqrt((ox + middle * dx) ** 2 + (oy + middle * dy) ** 2 + (oz + middle * dz) ** 2), a


@inlined
def eye_of(pose):
    cos, sin = heading_of(pose)
    return pose[0], pose[1], pose[2], cos, sin
