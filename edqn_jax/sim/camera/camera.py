"""A pinhole camera by analytic ray casting: depth, luma and RGB of a scene from any pose.

Brightness of a pixel is its area average: Lambert shade under a sun x albedo x texture. Between two frames
0.04 s apart silhouettes move by a fraction of a pixel, so the fraction has to be right: shapes become layers
of exact coverage (`coverage.py`), the nearest few are blended over ground and sky, and the texture is
box-filtered over the pixel (`texture.py`).
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera import columns, coverage, native, raycast, shadows
from edqn_jax.sim.camera.columns import Frame
from edqn_jax.sim.camera.coverage import Layers
from edqn_jax.sim.camera.depth import nearest_depth
from edqn_jax.sim.camera.primitive import render_in_one_batch
from edqn_jax.sim.camera.raycast import Rays
from edqn_jax.sim.camera.surfaces import albedo_factor, surfaces_at_eye
from edqn_jax.sim.camera.texture import texture_factor
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.scene.shapes.kind import safe_inverse
from edqn_jax.sim.scene.shapes.plane import HORIZON_M
from edqn_jax.xla import materialise_tree

LUMA_WEIGHTS = (0.299, 0.587, 0.114)
"""Weights of R, G and B in Eq. 1."""

Pixels = TypeVar("Pixels", Array, np.ndarray)


def _factor(
    config: CameraConfig, frame: Frame, shape: Array | None, rays: Rays, depth: Array, slopes: tuple[Array, Array]
) -> Array:
    """Returns the factor [H, W] of plaid or patterns; `shape` is the number of the shape that each pixel shows."""
    if frame.surfaces is None or shape is None:
        return texture_factor(config, frame.origin, rays, depth, *slopes)
    return albedo_factor(frame.surfaces, shape, rays, depth, *slopes)


def _with_shadows(config: CameraConfig, frame: Frame, rays: Rays, layers: Layers) -> Layers:
    """Returns the layers with the shadows that are cast on them: there, `Layer.value` is that of the ambient light."""
    light = raycast.daylight_of(config, frame.scene.daylight)
    joined: Any = jax.tree.map(lambda *parts: jnp.stack(parts), *layers)
    depth = jnp.where(joined.closeness > 0, safe_inverse(joined.closeness), 0.0)
    first = raycast.first_numbers(frame.value)
    dark = shadows.in_shadow(frame.scene, light, frame.origin, rays, depth, joined.shape, first)
    ambient = joined.coverage * shadows.ambient_of(light, frame.value, joined.shape)
    values = jnp.where(dark, ambient, joined.value)
    return tuple(dataclasses.replace(layer, value=value) for layer, value in zip(layers, values, strict=True))


def _backdrop(config: CameraConfig, frame: Frame, rays: Rays) -> Array:
    """Returns brightness [H, W] of textured ground and other planes before the sky."""
    scene, origin, value = frame.scene, frame.origin, frame.value
    light, first = raycast.daylight_of(config, scene.daylight), raycast.first_numbers(value)["planes"]
    shape = jnp.broadcast_shapes(rays.dx.shape, rays.dz.shape)
    behind = jnp.broadcast_to(frame.sky, shape)
    if scene.planes.normal.shape[0] == 0:
        return behind
    depth, shown, share = jnp.full(shape, jnp.inf), jnp.zeros(shape), jnp.zeros(shape)
    slopes, number = (jnp.zeros(shape), jnp.zeros(shape)), jnp.zeros(shape)
    for n in range(scene.planes.normal.shape[0]):
        normal = scene.planes.normal[n]
        height = jnp.dot(origin - scene.planes.position[n], normal)
        across, along = jnp.dot(normal, rays.right) * rays.pitch, jnp.dot(normal, rays.up) * rays.pitch
        # The plane's horizon is the line n . d = 0; the part of the pixel below it is covered by the plane.
        approach = normal[0] * rays.dx + normal[1] * rays.dy + normal[2] * rays.dz
        spread = jnp.abs(across) + jnp.abs(along)
        covered = jnp.clip(0.5 - approach * safe_inverse(spread), 0.0, 1.0)
        middle = (approach - spread / 2 + jnp.minimum(approach + spread / 2, 0.0)) / 2
        t = -height * safe_inverse(middle)
        # On a plane t = h / (n . d), so dt = -t (n . d') / (n . d), exactly.
        relative = -t * safe_inverse(middle)
        seen = (middle < 0) & (t > 0) & (t < HORIZON_M) & (t < depth)
        depth = jnp.where(seen, t, depth)
        share = jnp.where(seen, covered, share)
        shown = jnp.where(seen, raycast.lambert_shade(light, *normal) * value["planes"][n], shown)
        slopes = jnp.where(seen, relative * across, slopes[0]), jnp.where(seen, relative * along, slopes[1])
        number = jnp.where(seen, first + n, number)
    if config.shadows:
        whole = coverage.Layer(safe_inverse(depth), jnp.ones(shape), shown, slopes[0], number)
        shown = _with_shadows(config, frame, rays, (whole,))[0].value
    factor = _factor(config, frame, number, rays, jnp.where(share > 0, depth, 0.0), slopes)
    return behind + share * (shown * factor - behind)


def blend_layers(config: CameraConfig, frame: Frame, rays: Rays, layers: Layers) -> Array:
    """Returns brightness [H, W] of the layers over ground and sky."""
    behind = _backdrop(config, frame, rays)
    if config.shadows and layers:
        layers = _with_shadows(config, frame, rays, layers)
    for layer in reversed(layers):
        met = layer.closeness > 0
        near = jnp.where(met, safe_inverse(layer.closeness), 0.0)
        level = layer.slope == coverage.LEVEL_FACE
        right = jnp.where(level, 0.0, -near * near * layer.slope)
        up = jnp.where(level, -near * safe_inverse(rays.dz) * rays.pitch, 0.0)
        factor = _factor(config, frame, layer.shape, rays, near, (right, up))
        behind = behind + jnp.where(met, layer.value * factor - layer.coverage * behind, 0.0)
    return behind


def _picture(config: CameraConfig, scene: Scene, origin: Array, rotation: Array, weights: Array) -> Array:
    """Returns brightness [H, W] under `weights` [3] of RGB."""
    draw = columns.render_columns if config.mount == "level" else _tilted_pictures
    image, size = (scene, origin, rotation, weights), (config.height, config.width)
    return render_in_one_batch(draw, (config, blend_layers), image, size, natively=_pictures_natively)


def _tilted_pictures(config: CameraConfig, finish: columns.Finish, *image: Any) -> Array:
    """Returns brightness as `columns.render_columns` does, for a camera that turns with the body."""
    return jax.vmap(partial(_tilted_picture, config, finish))(*image)


def _tilted_picture(
    config: CameraConfig, finish: columns.Finish, scene: Scene, origin: Array, rotation: Array, weights: Array
) -> Array:
    value = raycast.albedo_values(scene, weights)
    rays = raycast.camera_rays(config, rotation)
    many = raycast.camera_rays(config, rotation, config.samples_across, config.samples_down)
    light, first = raycast.daylight_of(config, scene.daylight), raycast.first_numbers(value)
    surfaces = surfaces_at_eye(scene, first, origin)
    layers = coverage.no_layers((config.height, config.width), numbered=columns.has_numbers(config, surfaces))
    for kind, met in raycast.hits(scene, origin, many, without=("spheres", "planes")).items():
        bright = raycast.brightness_of(light, met, value[kind])
        layers = coverage.add_sampled_layers(met, bright, first[kind], many, layers)
    layers = coverage.sphere_layers(config, scene, origin, rays, value, layers)
    sky = jnp.sum(jnp.asarray(light.sky) * weights)
    frame = Frame(origin=origin, heading=rotation[:2, 0], scene=scene, value=value, sky=sky, surfaces=surfaces)
    return materialise_tree(finish(config, frame, rays, layers))


def render_luma(config: CameraConfig, scene: Scene, position: Array, rotation: Array) -> Array:
    """Returns linear luma of the scene, each pixel the average over its area.

    Shade and texture multiply R, G and B alike, so the luma of Eq. 1 needs one channel, not three.

    Args:
        position: [3] metres.
        rotation: [3, 3] body-to-world; the camera looks along body x with body z up. A level mount keeps
            only the heading.

    Returns:
        [H, W] in [0, 1], row 0 at the top.
    """
    return _picture(config, scene, position, rotation, jnp.asarray(LUMA_WEIGHTS))


def render_rgb(config: CameraConfig, scene: Scene, position: Array, rotation: Array) -> Array:
    """Returns linear RGB [H, W, 3] in [0, 1] from `position` [3], metres; `render_luma` is its weighted sum (Eq. 1)."""
    channels = jax.vmap(lambda weights: _picture(config, scene, position, rotation, weights))(jnp.eye(3))
    return jnp.moveaxis(channels, 0, -1)


def fine_rgb(config: CameraConfig, scale: int, scene: Scene, position: Array, rotation: Array) -> Array:
    """Returns linear RGB [scale H, scale W, 3] for people: the same view in pixels `scale` times finer per axis.

    Args:
        rotation: [3, 3] of the camera itself, body-to-world; the mount is not applied.
    """
    # Fine pixels need only one ray each, and the body-mounted camera's program is the quickest to compile.
    size = {"width": config.width * scale, "height": config.height * scale}
    lens = dataclasses.replace(config, **size, mount="body", samples_across=1, samples_down=1)
    return render_rgb(lens, scene, position, rotation)


def on_screen(linear: Pixels) -> Pixels:
    """Returns linear brightness as screens show it (gamma 2.2), in [0, 1]."""
    return linear.clip(0.0, 1.0) ** (1 / 2.2)


def render_depth(config: CameraConfig, scene: Scene, position: Array, rotation: Array) -> Array:
    """Returns the distance along each pixel's central ray: [H, W] metres, inf where the ray meets nothing."""
    nearest = render_in_one_batch(
        _depths, (config,), (scene, position, rotation), (config.height, config.width), natively=_depths_natively
    )
    rays = raycast.camera_rays(config, rotation)
    return nearest * jnp.sqrt(rays.dx**2 + rays.dy**2 + rays.dz**2)


def _pictures_natively(platform: str, config: CameraConfig, _: columns.Finish, *image: Any) -> Array | None:
    """Returns brightness [M, H, W] by the library in C or CUDA, blended as by `blend_layers`; None if unsupported."""
    can = native.can_render(image[0], platform, config.shadows)
    return native.render_luma(config, *image) if can else None


def _depths(config: CameraConfig, scene: Scene, position: Array, rotation: Array) -> Array:
    """Returns the depth [M, H, W] metres along the optical axis; every array has a leading [M]."""

    def one(scene: Scene, position: Array, rotation: Array) -> Array:
        return nearest_depth(scene, position, raycast.camera_rays(config, rotation))

    return jax.vmap(one)(scene, position, rotation)


def _depths_natively(
    platform: str, config: CameraConfig, scene: Scene, position: Array, rotation: Array
) -> Array | None:
    """Returns `_depths` by the library in C or CUDA; None if unsupported."""
    can = native.can_render(scene, platform)
    return native.render_depth(config, scene, position, rotation) if can else None
