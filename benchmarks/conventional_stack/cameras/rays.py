"""The level camera by `mj_multiRay`: one ray through the middle of each pixel, shade and texture in numba.

Texture is box-filtered over the pixel's footprint as in our camera; silhouettes are hard, because there is one ray per
pixel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from conventional_stack.c_mujoco import mj_multi_ray
from conventional_stack.cameras.optics import heading_of, optics_of
from conventional_stack.stopwatch import Stopwatch
from conventional_stack.world import World
from edqn_jax.config import CameraConfig
from edqn_jax.extras import require_extra
from edqn_jax.sim.scene.shapes.plane import HORIZON_M
from edqn_jax.sim.sensors.sensor import DEPTH_SCALE, HALF_NEAR_M

numba = require_extra("numba")


class Hits(NamedTuple):
    """Ray hits of M frames. P = H x W rays per frame, row by row from the top."""

    ray: NDArray[np.float64]  # [M, P, 3] with unit forward component
    geom: NDArray[np.int32]  # [M, P], -1 without a hit
    depth: NDArray[np.float64]  # [M, P] along the optical axis, metres
    normal: NDArray[np.float64]  # [M, P, 3] unit

    @classmethod
    def empty(cls, frames: int, pixels: int) -> Hits:
        """Allocates arrays for so many frames."""
        shape = (frames, pixels)
        return cls(np.empty((*shape, 3)), np.empty(shape, np.int32), np.empty(shape), np.empty((*shape, 3)))

    def first(self, frames: int) -> Hits:
        """Returns the hits of the first frames, as views."""
        return Hits(self.ray[:frames], self.geom[:frames], self.depth[:frames], self.normal[:frames])


@numba.njit(cache=True, error_model="numpy")
def cast(model, data, optics, pose, hits):
    """Casts the rays of M frames.

    Args:
        model, data: addresses of those of the world.
        pose: [M, 7] position and quaternion; roll and pitch are removed.
        hits: of M frames, output.
    """
    width, height = len(optics.u), len(optics.v)
    for m in range(len(pose)):
        cos, sin = heading_of(pose[m])
        ray = hits.ray[m]
        for row in range(height):
            for column in range(width):
                at = row * width + column
                ray[at, 0] = cos + optics.u[column] * sin
                ray[at, 1] = sin - optics.u[column] * cos
                ray[at, 2] = optics.v[row]
        mj_multi_ray(
            model, data, pose[m].ctypes.data, ray.ctypes.data, 0, 1, -1,
            hits.geom[m].ctypes.data, hits.depth[m].ctypes.data, hits.normal[m].ctypes.data,
            width * height, HORIZON_M,
        )  # fmt: skip


@numba.njit(cache=True, inline="always")
def _box_filter(cycles):
    """Returns the factor of a wave's amplitude averaged over `cycles` periods, as `sim/camera/texture.py`."""
    x = min(cycles * cycles, 1.0)
    return (1.0 - x) * (1.0 - 0.55 * x)


@numba.njit(cache=True, inline="always")
def _wave(phase):
    f = phase - math.floor(phase + 0.5)
    return f * (8.0 - 16.0 * abs(f))


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def shade(geoms, optics, pose, hits, luma):
    """Computes the luma [M, P] of M frames from their ray hits: albedo x Lambert shade x texture."""
    for m in range(len(pose)):
        cos, sin = heading_of(pose[m])
        ox, oy, oz = pose[m, 0], pose[m, 1], pose[m, 2]
        for p in range(luma.shape[1]):
            geom = hits.geom[m, p]
            if geom < 0:
                luma[m, p] = optics.sky
                continue
            t = hits.depth[m, p]
            dx, dy, dz = hits.ray[m, p, 0], hits.ray[m, p, 1], hits.ray[m, p, 2]
            nx, ny, nz = hits.normal[m, p, 0], hits.normal[m, p, 1], hits.normal[m, p, 2]
            lit = nx * optics.sun[0] + ny * optics.sun[1] + nz * optics.sun[2]
            bright = (optics.ambient + (1 - optics.ambient) * max(lit, 0.0)) * geoms.luma[geom]
            # On a plane t = h / (n . d), which gives the change of depth across the pixel.
            approach = nx * dx + ny * dy + nz * dz
            relative = optics.pitch / (approach if abs(approach) > 1e-9 else -1e-9)
            slope_right, slope_up = -t * relative * (nx * sin - ny * cos), -t * relative * nz
            total = 1.0
            for k in range(len(optics.weights)):
                kx, ky, kz = optics.waves[k, 0], optics.waves[k, 1], optics.waves[k, 2]
                along = kx * dx + ky * dy + kz * dz
                right = t * (kx * sin - ky * cos) * optics.pitch + slope_right * along
                up = t * kz * optics.pitch + slope_up * along
                phase = kx * ox + ky * oy + kz * oz + t * along
                total += optics.weights[k] * _box_filter(right) * _box_filter(up) * _wave(phase)
            luma[m, p] = bright * total


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def nearness(hits, label):
    """Computes `edqn_jax.sim.sensors.sensor.nearness_image` of M frames from their ray hits, into `label` [M, P].

    Of the metres along each ray, not along the optical axis; the sky is 0.
    """
    for m in range(len(label)):
        for p in range(label.shape[1]):
            dx, dy, dz = hits.ray[m, p, 0], hits.ray[m, p, 1], hits.ray[m, p, 2]
            metres = hits.depth[m, p] * math.sqrt(dx * dx + dy * dy + dz * dz)
            label[m, p] = DEPTH_SCALE / (1.0 + metres / HALF_NEAR_M) if hits.geom[m, p] >= 0 else 0.0


class RayCamera:
    """A `Camera` by rays."""

    block = 8

    def __init__(self, config: CameraConfig, world: World, drones: int) -> None:
        """Allocates the hits of a block of so many drones."""
        self.world, self.optics = world, optics_of(config)
        self.hits = [Hits.empty(drones, config.height * config.width) for _ in range(2)]

    def draw(
        self,
        stopwatch: Stopwatch,
        poses: NDArray[np.float64],
        luma: NDArray[np.float64],
        label: NDArray[np.float32] | None,
    ) -> None:
        """Draws as `Camera.draw`."""
        world, hits = self.world, [frame.first(poses.shape[1]) for frame in self.hits]
        with stopwatch.time("rays"):
            for at in range(2):
                cast(world.model._address, world.data._address, self.optics, poses[at], hits[at])
        with stopwatch.time("shading"):
            for at in range(2):
                shade(world.geoms, self.optics, poses[at], hits[at], luma[at])
            if label is not None:
                nearness(hits[1], label)
