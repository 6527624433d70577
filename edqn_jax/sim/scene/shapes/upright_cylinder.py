"""Cylinders whose axis is world z."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.sim.scene.motion import Motion
from edqn_jax.sim.scene.shapes.faces import faces_of_tube
from edqn_jax.sim.scene.shapes.kind import (
    FAR,
    GREY,
    UP,
    Geom,
    Hits,
    ShapeKind,
    Vector,
    array_module,
    norm,
    offset,
    solid_distance,
)
from edqn_jax.sim.scene.shapes.tilted_cylinder import Tubes, meet_tubes
from edqn_jax.sim.scene.surface import Surface


@struct.dataclass
class UprightCylinders:
    """Cylinders whose axis is world z."""

    position: Array  # [N, 3] centre, metres
    radius: Array  # [N] metres
    half_height: Array  # [N] metres
    albedo: Array  # [N, 3]
    motion: Motion | None = None
    surface: Surface | None = None


def _distance(cylinders: UprightCylinders, x: Array, y: Array, z: Array) -> Array:
    dx, dy, dz = offset(cylinders.position, x, y, z)
    return solid_distance(norm(dx, dy) - cylinders.radius, jnp.abs(dz) - cylinders.half_height)


def _meet(cylinders: UprightCylinders, origin: Array, ray: Vector) -> Hits:
    axis = jnp.zeros_like(cylinders.position).at[:, 2].set(1.0)
    return meet_tubes(
        Tubes(cylinders.position, axis, cylinders.half_height, cylinders.radius), origin, ray, capped=True
    )


def _read(geom: Geom) -> UprightCylinders | None:
    if not geom.is_upright():
        return None
    radius, half, _ = geom.size
    return UprightCylinders(position=geom.position, radius=radius, half_height=half, albedo=geom.albedo)  # type: ignore[arg-type]


def _reach(cylinders: Any) -> Any:
    xp = array_module(cylinders.radius)
    return xp.stack([cylinders.radius, cylinders.radius, cylinders.half_height], axis=-1)


_NONE = np.float32(0)

UPRIGHT_CYLINDER = ShapeKind(
    parked=UprightCylinders(position=FAR, radius=_NONE, half_height=_NONE, albedo=GREY),  # type: ignore[arg-type]
    geom="cylinder",
    distance=_distance,
    meet=_meet,
    read=_read,
    write=lambda cylinder: {"size": [cylinder.radius, cylinder.half_height]},
    reach=_reach,
    faces=lambda cylinder: faces_of_tube(cylinder.position, UP, float(cylinder.radius), float(cylinder.half_height)),
    page=lambda cylinder: {
        "kind": "cylinder", "axis": UP, "half": cylinder.half_height, "radius": cylinder.radius,
    },
)  # fmt: skip
