"""Boxes at any rotation."""

from __future__ import annotations

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
    Hits,
    ShapeKind,
    Vector,
    offset,
    per_shape,
    quaternion_of,
    safe_inverse,
    solid_distance,
)
from edqn_jax.sim.scene.surface import Surface


@struct.dataclass
class TiltedBoxes:
    """Boxes at any rotation."""

    position: Array  # [N, 3] centre, metres
    half: Array  # [N, 3] half extents, metres
    rotation: Array  # [N, 3, 3] body-to-world; columns are the box's axes
    albedo: Array  # [N, 3]
    motion: Motion | None = None
    surface: Surface | None = None


def _distance(boxes: TiltedBoxes, x: Array, y: Array, z: Array) -> Array:
    dx, dy, dz = offset(boxes.position, x, y, z)
    r = boxes.rotation
    return solid_distance(
        *(jnp.abs(r[:, 0, i] * dx + r[:, 1, i] * dy + r[:, 2, i] * dz) - boxes.half[:, i] for i in range(3))
    )


def _meet(boxes: TiltedBoxes, origin: Array, ray: Vector) -> Hits:
    away = origin[None] - boxes.position
    axes: Any = tuple(tuple(boxes.rotation[:, j, i] for j in range(3)) for i in range(3))
    o: Any = tuple(per_shape(jnp.sum(jnp.stack(axis, axis=1) * away, axis=1)) for axis in axes)
    d: Any = tuple(
        per_shape(axis[0]) * ray[0] + per_shape(axis[1]) * ray[1] + per_shape(axis[2]) * ray[2] for axis in axes
    )
    return slabs(o, d, boxes.half, axes)


def slabs(o: Vector, d: Vector, half: Array, axes: tuple[Vector, Vector, Vector]) -> Hits:
    """Returns where rays [N, R, C] meet boxes, each three slabs.

    Args:
        o, d: origin and direction in the box's frame, broadcast to [N, R, C].
        half: [N, 3] metres.
        axes: of the box in the world, components [N].
    """
    enter, leave = jnp.asarray(-jnp.inf), jnp.asarray(jnp.inf)
    sides: list[tuple[Any, Vector]] = []
    for i in range(3):
        per_d = safe_inverse(d[i])
        middle, reach = -o[i] * per_d, per_shape(half[:, i]) * jnp.abs(per_d)
        x, y, z = (per_shape(a) for a in axes[i])
        near = middle - reach
        nearest = near > enter
        sides += [(nearest if i else None, (-x, -y, -z)), (nearest & (d[i] < 0), (x, y, z))]
        enter, leave = jnp.maximum(enter, near), jnp.minimum(leave, middle + reach)
    return Hits(depth=enter, hit=(enter < leave) & (enter > 0), sides=sides)


TILTED_BOX = ShapeKind(
    parked=TiltedBoxes(position=FAR, half=np.zeros(3), rotation=np.eye(3), albedo=GREY),  # type: ignore[arg-type]
    geom="box",
    distance=_distance,
    meet=_meet,
    read=lambda geom: TiltedBoxes(geom.position, geom.size, geom.rotation, geom.albedo),  # type: ignore[arg-type]
    write=lambda box: {"size": box.half, "quat": quaternion_of(box.rotation)},
    reach=lambda boxes: (abs(boxes.rotation) * boxes.half[..., None, :]).sum(-1),
    faces=lambda box: faces_of_box(box.position, box.half, box.rotation),
    page=lambda box: {"kind": "box", "half": box.half, "turn": box.rotation.ravel()},
)
