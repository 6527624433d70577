"""Boxes rotated about the vertical only."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.sim.scene.motion import Motion
from edqn_jax.sim.scene.shapes.faces import faces_of_box
from edqn_jax.sim.scene.shapes.kind import (
    FAR,
    GREY,
    Geom,
    Hits,
    ShapeKind,
    Vector,
    array_module,
    offset,
    per_shape,
    solid_distance,
)
from edqn_jax.sim.scene.shapes.tilted_box import slabs
from edqn_jax.sim.scene.surface import Surface


@struct.dataclass
class UprightBoxes:
    """Boxes rotated about the vertical only. N is the capacity."""

    position: Array  # [N, 3] centre, metres
    half: Array  # [N, 3] half extents, metres
    yaw: Array  # [N] rotation about world z, radians
    albedo: Array  # [N, 3] RGB reflectance in [0, 1]
    motion: Motion | None = None
    surface: Surface | None = None


def _distance(boxes: UprightBoxes, x: Array, y: Array, z: Array) -> Array:
    dx, dy, dz = offset(boxes.position, x, y, z)
    c, s = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    return solid_distance(
        jnp.abs(c * dx + s * dy) - boxes.half[:, 0],
        jnp.abs(c * dy - s * dx) - boxes.half[:, 1],
        jnp.abs(dz) - boxes.half[:, 2],
    )


def _meet(boxes: UprightBoxes, origin: Array, ray: Vector) -> Hits:
    cos, sin = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    ox, oy = origin[0] - boxes.position[:, 0], origin[1] - boxes.position[:, 1]
    dx, dy, dz = ray
    d = (per_shape(cos) * dx + per_shape(sin) * dy, per_shape(cos) * dy - per_shape(sin) * dx, dz)
    o = (cos * ox + sin * oy, cos * oy - sin * ox, origin[2] - boxes.position[:, 2])
    zero, one = jnp.zeros_like(cos), jnp.ones_like(cos)
    axes = ((cos, sin, zero), (-sin, cos, zero), (zero, zero, one))
    return slabs((per_shape(o[0]), per_shape(o[1]), per_shape(o[2])), d, boxes.half, axes)


def _read(geom: Geom) -> UprightBoxes | None:
    """Reads a box of which any axis is vertical."""
    for vertical, across, deep in ((2, 0, 1), (0, 1, 2), (1, 0, 2)):
        if geom.is_upright(vertical):
            yaw: Any = math.atan2(geom.rotation[1, across], geom.rotation[0, across])
            half: Any = geom.size[[across, deep, vertical]]
            place: Any = geom.position
            return UprightBoxes(position=place, half=half, yaw=yaw, albedo=geom.albedo)  # type: ignore[arg-type]
    return None


def _reach(boxes: Any) -> Any:
    xp = array_module(boxes.yaw)
    c, s = abs(xp.cos(boxes.yaw)), abs(xp.sin(boxes.yaw))
    x, y, z = (boxes.half[..., i] for i in range(3))
    return xp.stack([c * x + s * y, s * x + c * y, z], axis=-1)


def _turn(box: Any) -> np.ndarray:
    """Returns the rotation [3, 3] of one box, body-to-world."""
    c, s = np.cos(box.yaw), np.sin(box.yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


UPRIGHT_BOX = ShapeKind(
    parked=UprightBoxes(position=FAR, half=np.zeros(3), yaw=np.float32(0), albedo=GREY),  # type: ignore[arg-type]
    geom="box",
    distance=_distance,
    meet=_meet,
    read=_read,
    write=lambda box: {"size": box.half, "euler": [0.0, 0.0, box.yaw]},
    reach=_reach,
    faces=lambda box: faces_of_box(box.position, box.half, _turn(box)),
    page=lambda box: {"kind": "box", "half": box.half, "turn": _turn(box).ravel()},
)
