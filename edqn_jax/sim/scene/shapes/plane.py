"""Half-spaces: the ground, ceilings, and whatever else has no end."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.sim.scene.shapes.kind import GREY, PARKED, UP, Hits, ShapeKind, Vector, offset, per_shape, safe_inverse
from edqn_jax.sim.scene.surface import Surface

HORIZON_M = 1e5
"""Depth beyond which nothing is drawn: parked shapes and rounding at the horizon."""


@struct.dataclass
class Planes:
    """Half-spaces: solid below the plane, free on the side that the normal points to."""

    position: Array  # [N, 3] any point of the plane, metres
    normal: Array  # [N, 3] unit
    albedo: Array  # [N, 3]
    surface: Surface | None = None


def _distance(planes: Planes, x: Array, y: Array, z: Array) -> Array:
    dx, dy, dz = offset(planes.position, x, y, z)
    return dx * planes.normal[:, 0] + dy * planes.normal[:, 1] + dz * planes.normal[:, 2]


def _meet(planes: Planes, origin: Array, ray: Vector) -> Hits:
    """Returns where rays meet planes from their free side."""
    nx, ny, nz = (per_shape(planes.normal[:, i]) for i in range(3))
    height = per_shape(jnp.sum((origin[None] - planes.position) * planes.normal, axis=-1))
    approach = nx * ray[0] + ny * ray[1] + nz * ray[2]
    t = -height * safe_inverse(approach)
    return Hits.of(t, (approach < 0) & (t > 0) & (t < HORIZON_M), (nx, ny, nz))


PLANE = ShapeKind(
    parked=Planes(position=np.array([0.0, 0.0, -PARKED]), normal=UP, albedo=GREY),  # type: ignore[arg-type]
    geom="plane",
    distance=_distance,
    meet=_meet,
    read=lambda geom: Planes(position=geom.position, normal=geom.rotation[:, 2], albedo=geom.albedo),  # type: ignore[arg-type]
    write=lambda plane: {"size": [0, 0, 1], "zaxis": plane.normal},
)
