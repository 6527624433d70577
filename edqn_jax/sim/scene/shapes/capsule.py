"""Capsules: cylinders of any axis with half spheres at their ends."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.sim.scene.motion import Motion
from edqn_jax.sim.scene.shapes.faces import faces_of_capsule
from edqn_jax.sim.scene.shapes.kind import (
    FAR,
    GREY,
    UP,
    Hits,
    ShapeKind,
    Vector,
    array_module,
    nearer_of,
    norm,
    offset,
)
from edqn_jax.sim.scene.shapes.sphere import meet_balls
from edqn_jax.sim.scene.shapes.tilted_cylinder import Tubes, meet_tubes, read_round, write_round
from edqn_jax.sim.scene.surface import Surface


@struct.dataclass
class Capsules:
    """Cylinders of any axis with half spheres at their ends."""

    position: Array  # [N, 3] centre, metres
    axis: Array  # [N, 3] unit direction
    half_length: Array  # [N] metres, of the straight part
    radius: Array  # [N] metres
    albedo: Array  # [N, 3]
    motion: Motion | None = None
    surface: Surface | None = None


def _distance(capsules: Capsules, x: Array, y: Array, z: Array) -> Array:
    dx, dy, dz = offset(capsules.position, x, y, z)
    ax, ay, az = capsules.axis[:, 0], capsules.axis[:, 1], capsules.axis[:, 2]
    along = jnp.clip(dx * ax + dy * ay + dz * az, -capsules.half_length, capsules.half_length)
    return norm(dx - along * ax, dy - along * ay, dz - along * az) - capsules.radius


def _meet(capsules: Capsules, origin: Array, ray: Vector) -> Hits:
    """Returns the nearest of the side and the two half spheres."""
    part = Tubes(capsules.position, capsules.axis, capsules.half_length, capsules.radius)
    whole = meet_tubes(part, origin, ray, capped=False)
    for end in (-1.0, 1.0):
        centre = capsules.position + end * capsules.half_length[:, None] * capsules.axis
        whole = nearer_of(whole, meet_balls(centre, capsules.radius, origin, ray))
    return whole


def _reach(capsules: Any) -> Any:
    xp = array_module(capsules.axis)
    return abs(capsules.axis) * xp.expand_dims(capsules.half_length, -1) + xp.expand_dims(capsules.radius, -1)


_NONE = np.float32(0)

CAPSULE = ShapeKind(
    parked=Capsules(position=FAR, axis=UP, half_length=_NONE, radius=_NONE, albedo=GREY),  # type: ignore[arg-type]
    geom="capsule",
    distance=_distance,
    meet=_meet,
    read=lambda geom: Capsules(**read_round(geom)),
    write=write_round,
    reach=_reach,
    faces=lambda one: faces_of_capsule(one.position, one.axis, float(one.radius), float(one.half_length)),
    page=lambda one: {"kind": "capsule", "axis": one.axis, "half": one.half_length, "radius": one.radius},
)
