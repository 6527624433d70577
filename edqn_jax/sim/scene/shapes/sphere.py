"""Spheres. Other drones of a group and balls that are thrown are spheres, too."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.sim.scene.motion import Motion, Throw
from edqn_jax.sim.scene.shapes.faces import faces_of_capsule
from edqn_jax.sim.scene.shapes.kind import (
    FAR,
    GREY,
    TINY,
    UP,
    Hits,
    ShapeKind,
    Vector,
    array_module,
    norm,
    offset,
    per_shape,
)
from edqn_jax.sim.scene.surface import Surface


@struct.dataclass
class Spheres:
    """Spheres, of which some may be balls."""

    position: Array  # [N, 3] centre, metres
    radius: Array  # [N] metres
    albedo: Array  # [N, 3]
    motion: Motion | None = None
    throw: Throw | None = None
    surface: Surface | None = None


def nearest_to_centre(away: Vector, radius: Array, ray: Vector) -> tuple[Array, Array, Array]:
    """Returns the depth at which rays enter spheres, and depth and distance of closest approach to their centres.

    Args:
        away: [N, 1, 1] each, metres, `origin - centre` of each sphere.
        radius: [N, 1, 1] metres.
        ray: direction, [1, R, C] each.
    """
    (ox, oy, oz), (dx, dy, dz) = away, ray
    a = dx**2 + dy**2 + dz**2
    s = -(ox * dx + oy * dy + oz * dz) / a
    # Through the ray's nearest point, not b^2 - a c, whose cancellation costs 1e-3 at 100 m.
    px, py, pz = ox + s * dx, oy + s * dy, oz + s * dz
    miss2 = px**2 + py**2 + pz**2
    return s - jnp.sqrt(jnp.maximum(radius**2 - miss2, 0.0) / a), s, jnp.sqrt(miss2)


def meet_balls(centre: Array, radius: Array, origin: Array, ray: Vector) -> Hits:
    """Returns where rays meet spheres of `centre` [N, 3] and `radius` [N], metres."""
    ox, oy, oz = (per_shape(origin[i] - centre[:, i]) for i in range(3))
    t, _, miss = nearest_to_centre((ox, oy, oz), per_shape(radius), ray)
    per_radius = per_shape(1.0 / jnp.maximum(radius, TINY))
    dx, dy, dz = ray
    normal = ((ox + t * dx) * per_radius, (oy + t * dy) * per_radius, (oz + t * dz) * per_radius)
    return Hits.of(t, (miss < per_shape(radius)) & (t > 0), normal)


def _distance(spheres: Spheres, x: Array, y: Array, z: Array) -> Array:
    return norm(*offset(spheres.position, x, y, z)) - spheres.radius


def _reach(spheres: Any) -> Any:
    xp = array_module(spheres.radius)
    return xp.stack([spheres.radius] * 3, axis=-1)


SPHERE = ShapeKind(
    parked=Spheres(position=FAR, radius=np.float32(0), albedo=GREY),  # type: ignore[arg-type]
    geom="sphere",
    distance=_distance,
    meet=lambda spheres, origin, ray: meet_balls(spheres.position, spheres.radius, origin, ray),
    read=lambda geom: Spheres(position=geom.position, radius=geom.size[0], albedo=geom.albedo),  # type: ignore[arg-type]
    write=lambda sphere: {"size": [sphere.radius]},
    reach=_reach,
    faces=lambda sphere: faces_of_capsule(sphere.position, UP, float(sphere.radius), 0.0),
    page=lambda sphere: {"kind": "sphere", "radius": sphere.radius},
)
