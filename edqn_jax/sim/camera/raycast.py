"""Ray casting: where each ray of a pinhole camera meets each shape, and the brightness there.

Where is what a shape's kind says (`meet` of `sim/scene/shapes`): `hits` collects depth and normal, kind by kind, with
the shape's index as the leading axis. What colour is there is said here alone, by `brightness_of`.

A ray is `origin + t * (dx, dy, dz)` with a unit forward component, so `t` is the depth along the optical
axis. For a level camera `dx, dy` depend on the image column only and `dz` on the row only; they are passed
with shapes [1, C] and [R, 1], and every quantity that needs only one of them is computed once per column or
row by broadcasting. A body-mounted camera passes full [R, C] components. N is the number of shapes of a kind.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from edqn_jax.config import SHAPES, CameraConfig
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.scene.shapes.kind import TINY, Hits, Vector, per_shape
from edqn_jax.sim.scene.surface import Daylight


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


UPRIGHT = ("boxes", "cylinders")
"""Kinds that a level camera draws by columns (`coverage.upright_table`)."""

Values = dict[str, Array]
"""Albedo of the shapes of each kind [N] as one number per shape: its luma, or one of its colours."""


def albedo_values(scene: Scene, weights: Array) -> Values:
    """Returns the albedo of every shape, weighted over RGB by `weights` [3]."""
    return {kind: shapes.albedo @ weights for kind, shapes in scene.shapes().items()}


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


def daylight_of(config: CameraConfig, light: Daylight | None) -> Daylight:
    """Returns the light of a world, that of the options where it has none of its own."""
    own = Daylight(sun=sun_direction(config), ambient=config.ambient, sky=config.sky_rgb)  # type: ignore[arg-type]
    return own if light is None else light


def lambert_shade(light: Daylight, nx: Array, ny: Array, nz: Array) -> Array:
    """Returns the Lambert shade [...] of a unit normal under the sun: ambient + (1 - ambient) max(0, n . sun)."""
    sx, sy, sz = light.sun[0], light.sun[1], light.sun[2]
    return light.ambient + (1 - light.ambient) * jnp.maximum(nx * sx + ny * sy + nz * sz, 0.0)


def direction_of(rays: Rays) -> Vector:
    """Returns the direction of rays, components [1, R, C], to broadcast against [N, 1, 1]."""
    return rays.dx[None], rays.dy[None], rays.dz[None]


def hits(scene: Scene, origin: Array, rays: Rays, without: tuple[str, ...] = ()) -> dict[str, Hits]:
    """Returns where rays from `origin` [3], metres, meet the shapes of every kind, but those of capacity 0.

    Args:
        without: kinds that are not asked; upright ones come last.
    """
    asked = sorted((kind for kind in scene.shapes() if kind not in without), key=UPRIGHT.__contains__)
    shapes = {kind: scene.shapes()[kind] for kind in asked}
    return {
        kind: SHAPES.get(kind).meet(each, origin, direction_of(rays))
        for kind, each in shapes.items()
        if each.position.shape[0]
    }


def first_numbers(values: Values) -> dict[str, int]:
    """Returns the number of the first shape of each kind, where all are counted: boxes, cylinders, others."""
    kinds = sorted(values, key=lambda kind: (kind not in UPRIGHT, kind))
    counts = [values[kind].shape[-1] for kind in kinds]
    return {kind: sum(counts[:place]) for place, kind in enumerate(kinds)}


def brightness_of(light: Daylight, met: Hits, value: Array) -> Array:
    """Returns the brightness without texture where rays meet shapes of albedo `value` [N]: shade times it [N, R, C]."""
    return met.by_side(lambda *normal: lambert_shade(light, *normal) * per_shape(value))
