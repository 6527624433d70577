"""The camera by brute force: many point samples a pixel, every shape tried for every ray, in float64 NumPy.

Nothing is filtered, nothing is clipped, nothing is projected: a sample's brightness is that of the nearest
surface its ray meets, and a pixel is the plain average of its samples.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera import raycast
from edqn_jax.sim.camera.texture import WAVES
from edqn_jax.sim.scene.scene import (
    Capsules,
    Planes,
    Scene,
    Shape,
    Spheres,
    TiltedBoxes,
    TiltedCylinders,
    UprightBoxes,
    UprightCylinders,
    scene_shapes,
)
from edqn_jax.sim.scene.surface import Daylight
from tests.oracles.surfaces_plain import factor


def luma(config: CameraConfig, scene: Scene, position: NDArray, rotation: NDArray, samples: int = 8) -> NDArray:
    """[H, W] luma from `samples` x `samples` rays per pixel."""
    return rgb(config, scene, position, rotation, samples) @ np.array([0.299, 0.587, 0.114])


def rgb(config: CameraConfig, scene: Scene, position: NDArray, rotation: NDArray, samples: int = 8) -> NDArray:
    """[H, W, 3] linear colour from `samples` x `samples` rays per pixel."""
    rays = directions(config, np.asarray(rotation, np.float64), samples)
    light = raycast.daylight_of(config, scene.daylight)
    flat = colours(config, scene_shapes(scene), np.asarray(position, np.float64), rays.reshape(-1, 3), light)
    shape = (config.height, samples, config.width, samples, 3)
    return flat.reshape(shape).mean(axis=(1, 3))


def directions(config: CameraConfig, rotation: NDArray, samples: int) -> NDArray:
    """[H * samples, W * samples, 3] ray directions, row 0 at the top."""
    if config.mount == "level":
        yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
        rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    focal = config.width * samples / 2 / np.tan(np.radians(config.horizontal_fov_deg) / 2)
    columns, rows = np.arange(config.width * samples) + 0.5, np.arange(config.height * samples) + 0.5
    right = (columns - config.width * samples / 2) / focal
    up = (config.height * samples / 2 - rows) / focal
    v, u = np.meshgrid(up, right, indexing="ij")
    return np.stack([np.ones_like(u), -u, v], axis=-1) @ rotation.T


def colours(
    config: CameraConfig, shapes: list[Shape], origin: NDArray, rays: NDArray, light: Daylight | None = None
) -> NDArray:
    """[K, 3] what each ray [K, 3] sees."""
    light = raycast.daylight_of(config, light)
    best = np.full(len(rays), np.inf)
    shown = np.tile(np.asarray(light.sky), (len(rays), 1))
    for shape in shapes:
        some = np.flatnonzero(_may_meet(shape, origin, rays))
        t, normal = meet(shape, origin, rays[some])
        nearer = t < best[some]
        some, t, normal = some[nearer], t[nearer], normal[nearer]
        best[some] = t
        points, surface = origin + t[:, None] * rays[some], shape.surface
        plaid = surface is None
        pattern = _texture(config, points) if plaid else factor(surface.numbers, shape.position, points)
        bright = _shade(light, normal) * pattern
        shown[some] = bright[:, None] * np.asarray(shape.albedo, np.float64)
    return shown


def _shade(light: Daylight, normal: NDArray) -> NDArray:
    ambient, sun = float(light.ambient), np.asarray(light.sun, np.float64)
    return ambient + (1 - ambient) * np.clip(normal @ sun, 0.0, None)


def _texture(config: CameraConfig, points: NDArray) -> NDArray:
    """A sum of waves of period 1, each two parabolas: rising from 0 to 1 at a quarter, back at a half."""
    total = np.zeros(len(points))
    for wave in WAVES:
        phase = points @ np.array(wave.direction) / (config.texture_period_m * wave.octave)
        along = phase - np.floor(phase)
        first, second = 16 * along * (0.5 - along), -16 * (along - 0.5) * (1.0 - along)
        total += wave.weight * np.where(along < 0.5, first, second)
    return 1.0 + config.texture_contrast * total


def _may_meet(shape: Shape, origin: NDArray, rays: NDArray) -> NDArray:
    """Whether the ray comes near enough to the ball around the shape: only to save time."""
    match shape:
        case Planes():
            return np.ones(len(rays), bool)
        case Spheres():
            reach = float(shape.radius)
        case UprightBoxes() | TiltedBoxes():
            reach = float(np.linalg.norm(shape.half))
        case UprightCylinders():
            reach = float(np.hypot(shape.radius, shape.half_height))
        case Capsules() | TiltedCylinders():
            reach = float(shape.radius + shape.half_length)
    centre = np.asarray(shape.position, np.float64) - origin
    along = rays @ centre
    near2 = centre @ centre - along**2 / np.sum(rays**2, axis=1)
    inside = centre @ centre <= reach**2
    return inside | ((along > 0) & (near2 <= 1.001 * reach**2))


def meet(shape: Shape, origin: NDArray, rays: NDArray) -> tuple[NDArray, NDArray]:
    """First meeting of rays [K, 3] with a shape: t [K], inf where there is none, and unit normal [K, 3]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        match shape:
            case UprightBoxes():
                return _box(shape.position, _turn(float(shape.yaw)), shape.half, origin, rays)
            case TiltedBoxes():
                return _box(shape.position, np.asarray(shape.rotation), shape.half, origin, rays)
            case UprightCylinders():
                up = np.array([0.0, 0.0, 1.0])
                return _cylinder(shape.position, up, shape.half_height, shape.radius, origin, rays)
            case TiltedCylinders():
                return _cylinder(shape.position, shape.axis, shape.half_length, shape.radius, origin, rays)
            case Spheres():
                return _ball(shape.position, shape.radius, origin, rays)
            case Capsules():
                return _capsule(shape, origin, rays)
            case Planes():
                normal = np.asarray(shape.normal, np.float64)
                height, approach = (origin - shape.position) @ normal, rays @ normal
                t = np.where((approach < 0) & (height > 0), -height / approach, np.inf)
                return t, np.broadcast_to(normal, rays.shape)
    raise TypeError(type(shape))


def _turn(yaw: float) -> NDArray:
    return np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])


def _box(position, rotation, half, origin: NDArray, rays: NDArray) -> tuple[NDArray, NDArray]:
    """Six faces, one after another: where the ray meets the face's plane, is that within the face?"""
    o, d = (origin - position) @ rotation, rays @ rotation
    best, normal = np.full(len(rays), np.inf), np.zeros(rays.shape)
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        for side in (-1.0, 1.0):
            t = (side * half[axis] - o[axis]) / d[:, axis]
            at = o + t[:, None] * d
            within = np.all(np.abs(at[:, others]) <= np.asarray(half)[others], axis=1)
            first = within & (t > 0) & (t < best) & (side * d[:, axis] < 0)
            best = np.where(first, t, best)
            normal[first] = side * np.asarray(rotation, np.float64)[:, axis]
    return best, normal


def _roots(a: NDArray, b: NDArray, c: NDArray) -> NDArray:
    """Smaller root of a t^2 + 2 b t + c, or inf."""
    under = b * b - a * c
    return np.where(under > 0, (-b - np.sqrt(np.maximum(under, 0.0))) / a, np.inf)


def _ball(position, radius, origin: NDArray, rays: NDArray) -> tuple[NDArray, NDArray]:
    o = origin - np.asarray(position, np.float64)
    t = _roots(np.sum(rays**2, axis=1), rays @ o, np.full(len(rays), o @ o - float(radius) ** 2))
    t = np.where(t > 0, t, np.inf)
    return t, (o + np.where(t < np.inf, t, 0.0)[:, None] * rays) / float(radius)


def _side(position, axis, half, radius, origin: NDArray, rays: NDArray) -> tuple[NDArray, NDArray]:
    """The round side of a cylinder without its ends."""
    axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    o = origin - np.asarray(position, np.float64)
    across_o, across_d = o - (o @ axis) * axis, rays - np.outer(rays @ axis, axis)
    radial = np.full(len(rays), across_o @ across_o - float(radius) ** 2)
    t = _roots(np.sum(across_d**2, axis=1), across_d @ across_o, radial)
    safe = np.where(t < np.inf, t, 0.0)[:, None]
    along = (o + safe * rays) @ axis
    t = np.where((t > 0) & (np.abs(along) <= float(half)), t, np.inf)
    return t, (across_o + safe * across_d) / float(radius)


def _cylinder(position, axis, half, radius, origin: NDArray, rays: NDArray) -> tuple[NDArray, NDArray]:
    axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    best, normal = _side(position, axis, half, radius, origin, rays)
    for side in (-1.0, 1.0):
        centre = np.asarray(position, np.float64) + side * float(half) * axis
        approach = rays @ (side * axis)
        t = ((centre - origin) @ (side * axis)) / approach
        off = origin + np.where(np.isfinite(t), t, 0.0)[:, None] * rays - centre
        first = (approach < 0) & (t > 0) & (np.sum(off**2, axis=1) <= float(radius) ** 2) & (t < best)
        best = np.where(first, t, best)
        normal = np.where(first[:, None], side * axis, normal)
    return best, normal


def _capsule(shape: Capsules, origin: NDArray, rays: NDArray) -> tuple[NDArray, NDArray]:
    best, normal = _side(shape.position, shape.axis, shape.half_length, shape.radius, origin, rays)
    for side in (-1.0, 1.0):
        end = shape.position + side * float(shape.half_length) * np.asarray(shape.axis, np.float64)
        t, n = _ball(end, shape.radius, origin, rays)
        first = t < best
        best, normal = np.where(first, t, best), np.where(first[:, None], n, normal)
    return best, normal
