"""Cylinders with any axis."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.sim.scene.motion import Motion
from edqn_jax.sim.scene.shapes.faces import faces_of_tube
from edqn_jax.sim.scene.shapes.kind import (
    FAR,
    GREY,
    TINY,
    UP,
    Geom,
    Hits,
    ShapeKind,
    Vector,
    array_module,
    norm,
    offset,
    per_shape,
    safe_inverse,
    solid_distance,
)
from edqn_jax.sim.scene.surface import Surface


@struct.dataclass
class TiltedCylinders:
    """Cylinders with any axis."""

    position: Array  # [N, 3] centre, metres
    axis: Array  # [N, 3] unit direction
    half_length: Array  # [N] metres
    radius: Array  # [N] metres
    albedo: Array  # [N, 3]
    motion: Motion | None = None
    surface: Surface | None = None


class Tubes(NamedTuple):
    """Round solids along an axis, as in `TiltedCylinders`."""

    position: Array
    axis: Array
    half_length: Array
    radius: Array


def meet_tubes(part: Tubes, origin: Array, ray: Vector, capped: bool) -> Hits:
    """Returns where rays from `origin` [3], metres, meet round sides of capsules, or (`capped`) whole cylinders."""
    dx, dy, dz = ray
    ox, oy, oz = (per_shape(origin[i] - part.position[:, i]) for i in range(3))
    ax, ay, az = (per_shape(part.axis[:, i]) for i in range(3))
    axis_o, axis_d = ox * ax + oy * ay + oz * az, dx * ax + dy * ay + dz * az
    qx, qy, qz = ox - axis_o * ax, oy - axis_o * ay, oz - axis_o * az
    ex, ey, ez = dx - axis_d * ax, dy - axis_d * ay, dz - axis_d * az
    a = jnp.maximum(ex**2 + ey**2 + ez**2, TINY)
    s = -(qx * ex + qy * ey + qz * ez) / a
    inside = per_shape(part.radius**2) - ((qx + s * ex) ** 2 + (qy + s * ey) ** 2 + (qz + s * ez) ** 2)
    reach = jnp.sqrt(jnp.maximum(inside, 0.0) / a)
    side_t = s - reach
    per_radius = per_shape(1.0 / jnp.maximum(part.radius, TINY))
    side = (
        (qx + side_t * ex) * per_radius,
        (qy + side_t * ey) * per_radius,
        (qz + side_t * ez) * per_radius,
    )
    if not capped:
        on_side = (inside > 0) & (jnp.abs(axis_o + side_t * axis_d) <= per_shape(part.half_length))
        return Hits.of(side_t, on_side & (side_t > 0), side)
    per_d = safe_inverse(axis_d)
    middle, half = -axis_o * per_d, per_shape(part.half_length) * jnp.abs(per_d)
    enter, leave = jnp.maximum(side_t, middle - half), jnp.minimum(s + reach, middle + half)
    hit = (inside > 0) & (enter < leave) & (enter > 0)
    on_end = middle - half > side_t
    sides = ((None, side), (on_end, (-ax, -ay, -az)), (on_end & (axis_d < 0), (ax, ay, az)))
    return Hits(depth=enter, hit=hit, sides=sides)


def _distance(cylinders: TiltedCylinders, x: Array, y: Array, z: Array) -> Array:
    dx, dy, dz = offset(cylinders.position, x, y, z)
    ax, ay, az = cylinders.axis[:, 0], cylinders.axis[:, 1], cylinders.axis[:, 2]
    along = dx * ax + dy * ay + dz * az
    radial = norm(dx - along * ax, dy - along * ay, dz - along * az)
    return solid_distance(radial - cylinders.radius, jnp.abs(along) - cylinders.half_length)


def _meet(cylinders: TiltedCylinders, origin: Array, ray: Vector) -> Hits:
    part = Tubes(cylinders.position, cylinders.axis, cylinders.half_length, cylinders.radius)
    return meet_tubes(part, origin, ray, capped=True)


def read_round(geom: Geom) -> dict[str, Any]:
    """Returns the fields of a round solid along the geom's z axis, as `TiltedCylinders` and capsules have them."""
    radius, half, _ = geom.size
    return {
        "position": geom.position,
        "axis": geom.rotation[:, 2],
        "half_length": half,
        "radius": radius,
        "albedo": geom.albedo,
    }


def write_round(one: Any) -> dict[str, Any]:
    """Returns the MJCF attributes that `read_round` reads, of a single shape."""
    return {"size": [one.radius, one.half_length], "zaxis": one.axis}


def _reach(cylinders: Any) -> Any:
    xp = array_module(cylinders.axis)
    across = xp.sqrt(xp.maximum(1.0 - cylinders.axis**2, 0.0))
    half, radius = xp.expand_dims(cylinders.half_length, -1), xp.expand_dims(cylinders.radius, -1)
    return abs(cylinders.axis) * half + across * radius


_NONE = np.float32(0)

TILTED_CYLINDER = ShapeKind(
    parked=TiltedCylinders(position=FAR, axis=UP, half_length=_NONE, radius=_NONE, albedo=GREY),  # type: ignore[arg-type]
    geom="cylinder",
    distance=_distance,
    meet=_meet,
    read=lambda geom: TiltedCylinders(**read_round(geom)),
    write=write_round,
    reach=_reach,
    faces=lambda one: faces_of_tube(one.position, one.axis, float(one.radius), float(one.half_length)),
    page=lambda one: {"kind": "cylinder", "axis": one.axis, "half": one.half_length, "radius": one.radius},
)
