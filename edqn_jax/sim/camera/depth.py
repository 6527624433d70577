"""Depth of the nearest surface along rays, for the sensors `depth` and `ranges` and for the encoder's labels.

Whether a ray passes over or under an upright shape depends on its row alone under a level camera, and whether it
passes beside the shape on its column alone. So for upright boxes and cylinders both are computed once per row and
column, and each pixel only compares them, one shape after another (docs/performance.md has the times). The other kinds
of shape say themselves where rays meet them.

N upright shapes; rays as in `raycast`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from edqn_jax.sim.camera import raycast
from edqn_jax.sim.camera.raycast import Rays, direction_of
from edqn_jax.sim.scene.scene import Scene, UprightBoxes, UprightCylinders
from edqn_jax.sim.scene.shapes.kind import TINY, per_shape, safe_inverse

UNROLLED = 16
"""Shapes that one pass over the pixels compares; between passes a GPU writes all pixels and reads them again."""


@struct.dataclass
class _Intervals:
    """Depths between which each ray is beside an upright shape's axis, and between its bottom and its top.

    Fields broadcast to [N, R, C]; an interval that ends before it begins is empty.
    """

    beside_from: Array
    beside_to: Array
    level_from: Array
    level_to: Array


def nearest_depth(scene: Scene, origin: Array, rays: Rays) -> Array:
    """Returns the depth of the nearest surface along each ray: [R, C] metres, inf where there is none."""
    shape = jnp.broadcast_shapes(rays.dx.shape, rays.dz.shape)
    nearest = jnp.full(shape, jnp.inf)
    for met in raycast.hits(scene, origin, rays, without=raycast.UPRIGHT).values():
        depth = jnp.where(met.hit, met.depth, jnp.inf)
        whole = jnp.broadcast_to(depth, depth.shape[:1] + shape)
        # A reduction over the leading axis takes several times as long on a CPU.
        nearest = lax.scan(lambda found, one: (jnp.minimum(found, one), None), nearest, whole, unroll=UNROLLED)[0]
    uprights = []
    if scene.boxes.yaw.shape[0]:
        uprights.append(_boxes(scene.boxes, origin, rays))
    if scene.cylinders.radius.shape[0]:
        uprights.append(_cylinders(scene.cylinders, origin, rays))
    if not uprights:
        return nearest
    joined = jax.tree.map(lambda *parts: jnp.concatenate(parts), *uprights)
    return lax.scan(_with_one_more, nearest, joined, unroll=UNROLLED)[0]


def _with_one_more(nearest: Array, intervals: _Intervals) -> tuple[Array, None]:
    """Returns the nearest depth [R, C] with one more upright shape, of which fields broadcast to [R, C]."""
    enter = jnp.maximum(intervals.beside_from, intervals.level_from)
    leave = jnp.minimum(intervals.beside_to, intervals.level_to)
    return jnp.minimum(nearest, jnp.where((enter < leave) & (enter > 0), enter, jnp.inf)), None


def _boxes(boxes: UprightBoxes, origin: Array, rays: Rays) -> _Intervals:
    """Returns the intervals of upright boxes: beside its axis a ray is between two pairs of parallel faces."""
    dx, dy, _ = direction_of(rays)
    cos, sin = per_shape(jnp.cos(boxes.yaw)), per_shape(jnp.sin(boxes.yaw))
    x, y = (per_shape(boxes.position[:, axis] - origin[axis]) for axis in range(2))
    per_x, per_y = safe_inverse(cos * dx + sin * dy), safe_inverse(cos * dy - sin * dx)
    middle = (cos * x + sin * y) * per_x, (cos * y - sin * x) * per_y
    reach = per_shape(boxes.half[:, 0]) * jnp.abs(per_x), per_shape(boxes.half[:, 1]) * jnp.abs(per_y)
    return _Intervals(
        jnp.maximum(middle[0] - reach[0], middle[1] - reach[1]),
        jnp.minimum(middle[0] + reach[0], middle[1] + reach[1]),
        *_level(boxes.position[:, 2] - origin[2], boxes.half[:, 2], rays),
    )


def _cylinders(cylinders: UprightCylinders, origin: Array, rays: Rays) -> _Intervals:
    """Returns the intervals of upright cylinders: beside its axis a ray is within the circle."""
    dx, dy, _ = direction_of(rays)
    ox, oy = (per_shape(origin[axis] - cylinders.position[:, axis]) for axis in range(2))
    flat = jnp.maximum(dx**2 + dy**2, TINY)
    nearest = -(ox * dx + oy * dy) / flat
    inside = per_shape(cylinders.radius**2) - ((ox + nearest * dx) ** 2 + (oy + nearest * dy) ** 2)
    reach = jnp.where(inside > 0, jnp.sqrt(jnp.maximum(inside, 0.0) / flat), -jnp.inf)
    heights = _level(cylinders.position[:, 2] - origin[2], cylinders.half_height, rays)
    return _Intervals(nearest - reach, nearest + reach, *heights)


def _level(middle: Array, half: Array, rays: Rays) -> tuple[Array, Array]:
    """Returns the depths between which rays are between bottom and top: `middle` [N] above the eye +- `half` [N]."""
    per_z = safe_inverse(rays.dz[None])
    at, reach = per_shape(middle) * per_z, per_shape(half) * jnp.abs(per_z)
    return at - reach, at + reach
