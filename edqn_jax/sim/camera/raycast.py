"""Ray casting: the depth at which each ray of a pinhole camera meets each shape, and the brightness there.

A ray is `origin + t * (dx, dy, dz)` with a unit forward component, so `t` is the depth along the optical
axis. For a level camera `dx, dy` depend on the image column only and `dz` on the row only; they are passed
with shapes [1, C] and [R, 1], and every quantity that needs only one of them is computed once per column or
row by broadcasting. A body-mounted camera passes full [R, C] components. N is the number of shapes of a kind.
"""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from edqn_jax.config import CameraConfig
from edqn_jax.sim.scene.scene import Capsules, Scene, TiltedCylinders

TINY = 1e-9
HORIZON_M = 1e5
"""Depth beyond which nothing is drawn: parked shapes and rounding at the horizon."""


@struct.dataclass
class Rays:
    """R x C rays; components broadcast against [R, C]."""

    dx: Array
    dy: Array
    dz: Array
    right: Array  # [3] change of direction per unit of image-plane u
    up: Array  # [3] change of direction per unit of image-plane v
    pitch: float = struct.field(pytree_node=False)  # pixel's width in the image plane
    across: int = struct.field(pytree_node=False)  # rays per pixel
    down: int = struct.field(pytree_node=False)


@struct.dataclass
class Surfaces:
    """N surfaces under every ray; fields broadcast to [N, R, C]."""

    depth: Array  # t of the first intersection
    hit: Array  # whether there is one, in front of the camera
    value: Array  # brightness there: albedo value times shade, no texture


@struct.dataclass
class Values:
    """Albedo of each shape as one number per shape: its luma, or one of its colours."""

    boxes: Array
    cylinders: Array
    spheres: Array
    tilted_boxes: Array
    capsules: Array
    tilted_cylinders: Array
    planes: Array


def albedo_values(scene: Scene, weights: Array) -> Values:
    """Returns the albedo of every shape, weighted over RGB by `weights` [3]."""
    return Values(
        boxes=scene.boxes.albedo @ weights,
        cylinders=scene.cylinders.albedo @ weights,
        spheres=scene.spheres.albedo @ weights,
        tilted_boxes=scene.tilted_boxes.albedo @ weights,
        capsules=scene.capsules.albedo @ weights,
        tilted_cylinders=scene.tilted_cylinders.albedo @ weights,
        planes=scene.planes.albedo @ weights,
    )


def image_plane(config: CameraConfig, across: int, down: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns image-plane coordinates at unit depth: u [across * W] rightwards, v [down * H] upwards.

    A pixel's rays are one image apart in the arrays (first ray of every pixel, second ray of every pixel, ...), so
    that averaging them adds images and is vectorised.
    """
    half = math.tan(math.radians(config.horizontal_fov_deg) / 2)
    columns, rows = config.width * across, config.height * down
    u = half * (2 * (np.arange(columns) + 0.5) / columns - 1)
    v = -half * config.height / config.width * (2 * (np.arange(rows) + 0.5) / rows - 1)
    u, v = u.reshape(config.width, across).T.ravel(), v.reshape(config.height, down).T.ravel()
    return u.astype(np.float32), v.astype(np.float32)


def pitch_of(config: CameraConfig) -> float:
    """Returns the width, and height, of a pixel in the image plane."""
    return 2 * math.tan(math.radians(config.horizontal_fov_deg) / 2) / config.width


def columns_of(config: CameraConfig) -> Array:
    """Returns the image-plane coordinate [W] of the middle of each column."""
    return jnp.asarray(image_plane(config, 1, 1)[0])


def column_rays(config: CameraConfig, heading: Array, u: Array, across: int = 1, down: int = 1) -> Rays:
    """Returns the rays [H * down, across] of one column of a level camera.

    Args:
        heading: [2] cosine and sine.
        u: [] middle of the column in the image plane.
        across, down: rays per pixel.
    """
    pitch = pitch_of(config)
    at = u + pitch * ((np.arange(across, dtype=np.float32) + 0.5) / across - 0.5)
    return _level_rays(config, heading[0], heading[1], at, image_plane(config, across, down)[1], across, down)


def _level_rays(config: CameraConfig, cos: Array, sin: Array, u, v, across: int, down: int) -> Rays:
    zero = jnp.zeros_like(cos)
    return Rays(
        dx=(cos + u * sin)[None, :],
        dy=(sin - u * cos)[None, :],
        dz=jnp.asarray(v)[:, None],
        right=jnp.stack([sin, -cos, zero]),
        up=jnp.stack([zero, zero, zero + 1]),
        pitch=pitch_of(config),
        across=across,
        down=down,
    )


def camera_rays(config: CameraConfig, rotation: Array, across: int = 1, down: int = 1) -> Rays:
    """Returns the rays of the camera for a body rotation.

    Args:
        rotation: [3, 3] body-to-world; the camera looks along body x, body z is up. A level mount keeps
            only the heading of body x.
        across, down: rays per pixel.
    """
    u, v = image_plane(config, across, down)
    if config.mount == "level":
        forward_x, forward_y = rotation[0, 0], rotation[1, 0]
        scale = lax.rsqrt(jnp.maximum(forward_x**2 + forward_y**2, TINY))
        return _level_rays(config, forward_x * scale, forward_y * scale, u, v, across, down)
    forward, left, up = rotation[:, 0], rotation[:, 1], rotation[:, 2]
    components = [forward[i] - u[None, :] * left[i] + v[:, None] * up[i] for i in range(3)]
    return Rays(
        dx=components[0],
        dy=components[1],
        dz=components[2],
        right=-left,
        up=up,
        pitch=pitch_of(config),
        across=across,
        down=down,
    )


def sun_direction(config: CameraConfig) -> tuple[float, float, float]:
    """Returns the unit vector towards the sun, in the world's axes."""
    azimuth, elevation = math.radians(config.sun_azimuth_deg), math.radians(config.sun_elevation_deg)
    flat = math.cos(elevation)
    return flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)


def shade(config: CameraConfig, nx: Array, ny: Array, nz: Array) -> Array:
    """Returns the Lambert shade [...] of a unit normal under the sun: ambient + (1 - ambient) max(0, n . sun)."""
    sx, sy, sz = sun_direction(config)
    return config.ambient + (1 - config.ambient) * jnp.maximum(nx * sx + ny * sy + nz * sz, 0.0)


def inverse(x: Array) -> Array:
    """Returns 1 / x of [...], finite at 0."""
    return 1.0 / jnp.where(jnp.abs(x) < TINY, TINY, x)


def per_shape(x: Array) -> Array:
    """Reshapes [N] to [N, 1, 1], to broadcast against [N, R, C]."""
    return x[:, None, None]


def for_shapes(rays: Rays) -> Rays:
    """Returns the same rays with components [1, R, C], to broadcast against [N, 1, 1]."""
    return dataclasses.replace(rays, dx=rays.dx[None], dy=rays.dy[None], dz=rays.dz[None])


def unit_ball(ox: Array, oy: Array, oz: Array, radius: Array, rays: Rays) -> tuple[Array, Array, Array]:
    """Returns the depth at which rays (`for_shapes`) enter spheres, and depth and distance of closest approach.

    ox, oy, oz: [N, 1, 1] metres, `origin - centre` of each sphere.
    """
    a = rays.dx**2 + rays.dy**2 + rays.dz**2
    s = -(ox * rays.dx + oy * rays.dy + oz * rays.dz) / a
    # Through the ray's nearest point, not b^2 - a c, whose cancellation costs 1e-3 at 100 m.
    px, py, pz = ox + s * rays.dx, oy + s * rays.dy, oz + s * rays.dz
    miss2 = px**2 + py**2 + pz**2
    return s - jnp.sqrt(jnp.maximum(radius**2 - miss2, 0.0) / a), s, jnp.sqrt(miss2)


def _sphere_surfaces(
    config: CameraConfig, origin: Array, rays: Rays, centre: Array, radius: Array, value: Array
) -> Surfaces:
    ox, oy, oz = (per_shape(origin[i] - centre[:, i]) for i in range(3))
    t, _, miss = unit_ball(ox, oy, oz, per_shape(radius), rays)
    per_radius = per_shape(1.0 / jnp.maximum(radius, TINY))
    normal = (ox + t * rays.dx, oy + t * rays.dy, oz + t * rays.dz)
    bright = shade(config, *(n * per_radius for n in normal)) * per_shape(value)
    return Surfaces(depth=t, hit=(miss < per_shape(radius)) & (t > 0), value=bright)


def _upright_box_surfaces(config: CameraConfig, origin: Array, rays: Rays, scene: Scene, value: Values) -> Surfaces:
    boxes = scene.boxes
    cos, sin = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    ox, oy = origin[0] - boxes.position[:, 0], origin[1] - boxes.position[:, 1]
    d = (
        per_shape(cos) * rays.dx + per_shape(sin) * rays.dy,
        per_shape(cos) * rays.dy - per_shape(sin) * rays.dx,
        rays.dz,
    )
    o = (cos * ox + sin * oy, cos * oy - sin * ox, origin[2] - boxes.position[:, 2])
    zero, one = jnp.zeros_like(cos), jnp.ones_like(cos)
    axes = ((cos, sin, zero), (-sin, cos, zero), (zero, zero, one))
    return _slabs(config, tuple(per_shape(x) for x in o), d, boxes.half, axes, value.boxes)


def _tilted_box_surfaces(config: CameraConfig, origin: Array, rays: Rays, scene: Scene, value: Values) -> Surfaces:
    boxes = scene.tilted_boxes
    offset = origin[None] - boxes.position
    axes = tuple(tuple(boxes.rotation[:, j, i] for j in range(3)) for i in range(3))
    o = tuple(per_shape(jnp.sum(jnp.stack(axis, axis=1) * offset, axis=1)) for axis in axes)
    d = tuple(
        per_shape(axis[0]) * rays.dx + per_shape(axis[1]) * rays.dy + per_shape(axis[2]) * rays.dz for axis in axes
    )
    return _slabs(config, o, d, boxes.half, axes, value.tilted_boxes)


def _slabs(config: CameraConfig, o, d, half: Array, axes, value: Array) -> Surfaces:
    """Returns surfaces of boxes, each three slabs.

    `o`, `d` are origin and direction in the box's frame, `axes` its axes in the world.
    """
    enter, leave = jnp.asarray(-jnp.inf), jnp.asarray(jnp.inf)
    bright = jnp.asarray(0.0)
    for i in range(3):
        per_d = inverse(d[i])
        middle, reach = -o[i] * per_d, per_shape(half[:, i]) * jnp.abs(per_d)
        facing, away = (per_shape(shade(config, *(sign * a for a in axes[i])) * value) for sign in (1.0, -1.0))
        near = middle - reach
        bright = jnp.where(near > enter, jnp.where(d[i] < 0, facing, away), bright)
        enter, leave = jnp.maximum(enter, near), jnp.minimum(leave, middle + reach)
    return Surfaces(depth=enter, hit=(enter < leave) & (enter > 0), value=bright)


def _tube_surfaces(
    config: CameraConfig,
    origin: Array,
    rays: Rays,
    part: Capsules | TiltedCylinders,
    value: Array,
    capped: bool,
) -> Surfaces:
    """Returns surfaces of the round sides of capsules, or (`capped`) of cylinders with flat ends."""
    ox, oy, oz = (per_shape(origin[i] - part.position[:, i]) for i in range(3))
    ax, ay, az = (per_shape(part.axis[:, i]) for i in range(3))
    axis_o, axis_d = ox * ax + oy * ay + oz * az, rays.dx * ax + rays.dy * ay + rays.dz * az
    qx, qy, qz = ox - axis_o * ax, oy - axis_o * ay, oz - axis_o * az
    ex, ey, ez = rays.dx - axis_d * ax, rays.dy - axis_d * ay, rays.dz - axis_d * az
    a = jnp.maximum(ex**2 + ey**2 + ez**2, TINY)
    s = -(qx * ex + qy * ey + qz * ez) / a
    inside = per_shape(part.radius**2) - ((qx + s * ex) ** 2 + (qy + s * ey) ** 2 + (qz + s * ez) ** 2)
    reach = jnp.sqrt(jnp.maximum(inside, 0.0) / a)
    side_t = s - reach
    per_radius = per_shape(1.0 / jnp.maximum(part.radius, TINY))
    side = shade(config, *((q + side_t * e) * per_radius for q, e in ((qx, ex), (qy, ey), (qz, ez))))
    if not capped:
        on_side = (inside > 0) & (jnp.abs(axis_o + side_t * axis_d) <= per_shape(part.half_length))
        return Surfaces(depth=side_t, hit=on_side & (side_t > 0), value=side * per_shape(value))
    per_d = inverse(axis_d)
    middle, half = -axis_o * per_d, per_shape(part.half_length) * jnp.abs(per_d)
    facing, away = (per_shape(shade(config, *(sign * part.axis[:, i] for i in range(3)))) for sign in (1.0, -1.0))
    enter, leave = jnp.maximum(side_t, middle - half), jnp.minimum(s + reach, middle + half)
    bright = jnp.where(middle - half > side_t, jnp.where(axis_d < 0, facing, away), side)
    hit = (inside > 0) & (enter < leave) & (enter > 0)
    return Surfaces(depth=enter, hit=hit, value=bright * per_shape(value))


def plane_surfaces(config: CameraConfig, scene: Scene, origin: Array, rays: Rays, value: Values) -> Surfaces:
    """Returns surfaces of half-spaces, visible from their free side, seen from `origin` [3], metres."""
    planes, rays = scene.planes, for_shapes(rays)
    nx, ny, nz = (per_shape(planes.normal[:, i]) for i in range(3))
    height = per_shape(jnp.sum((origin[None] - planes.position) * planes.normal, axis=-1))
    approach = nx * rays.dx + ny * rays.dy + nz * rays.dz
    t = -height * inverse(approach)
    bright = shade(config, nx, ny, nz) * per_shape(value.planes)
    return Surfaces(depth=t, hit=(approach < 0) & (t > 0) & (t < HORIZON_M), value=bright)


def upright_surfaces(config: CameraConfig, scene: Scene, origin: Array, rays: Rays, value: Values) -> list[Surfaces]:
    """Returns surfaces of upright boxes and cylinders, seen from `origin` [3], metres, without kinds of capacity 0."""
    found, rays = [], for_shapes(rays)
    if scene.boxes.yaw.shape[0]:
        found.append(_upright_box_surfaces(config, origin, rays, scene, value))
    upright = scene.cylinders
    if upright.radius.shape[0]:
        axis = jnp.zeros_like(upright.position).at[:, 2].set(1.0)
        standing = TiltedCylinders(
            position=upright.position,
            axis=axis,
            half_length=upright.half_height,
            radius=upright.radius,
            albedo=upright.albedo,
        )
        found.append(_tube_surfaces(config, origin, rays, standing, value.cylinders, capped=True))
    return found


def other_surfaces(config: CameraConfig, scene: Scene, origin: Array, rays: Rays, value: Values) -> list[Surfaces]:
    """Returns surfaces of tilted boxes, tilted cylinders and capsules, seen from `origin` [3], metres.

    Kinds of capacity 0 have none. A capsule is one surface: the nearest of its side and its two half spheres.
    """
    found, rays = [], for_shapes(rays)
    if scene.tilted_boxes.half.shape[0]:
        found.append(_tilted_box_surfaces(config, origin, rays, scene, value))
    tilted = scene.tilted_cylinders
    if tilted.radius.shape[0]:
        found.append(_tube_surfaces(config, origin, rays, tilted, value.tilted_cylinders, capped=True))
    capsules = scene.capsules
    if capsules.radius.shape[0]:
        whole = _tube_surfaces(config, origin, rays, capsules, value.capsules, capped=False)
        for end in (-1.0, 1.0):
            centre = capsules.position + end * capsules.half_length[:, None] * capsules.axis
            cap = _sphere_surfaces(config, origin, rays, centre, capsules.radius, value.capsules)
            whole = _nearer_of(whole, cap)
        found.append(whole)
    return found


def sphere_surfaces(config: CameraConfig, scene: Scene, origin: Array, rays: Rays, value: Values) -> list[Surfaces]:
    """Returns surfaces of spheres, seen from `origin` [3], metres; an empty list when the capacity is 0."""
    spheres = scene.spheres
    if not spheres.radius.shape[0]:
        return []
    rays = for_shapes(rays)
    return [_sphere_surfaces(config, origin, rays, spheres.position, spheres.radius, value.spheres)]


def _nearer_of(a: Surfaces, b: Surfaces) -> Surfaces:
    """Returns the union of two surfaces of the same shapes: the one that each ray meets first."""
    take_b = b.hit & (~a.hit | (b.depth < a.depth))
    return Surfaces(
        depth=jnp.where(take_b, b.depth, a.depth),
        hit=a.hit | b.hit,
        value=jnp.where(take_b, b.value, a.value),
    )
