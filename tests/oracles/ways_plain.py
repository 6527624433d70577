"""Whether there is a way, in NumPy and float64: the nodes of `sim.worlds.reachability` and a library's labels."""

from __future__ import annotations

import itertools

import numpy as np
from scipy import ndimage

from edqn_jax.sim.scene.scene import Planes, Scene, UprightBoxes, UprightCylinders, scene_shapes
from edqn_jax.sim.worlds.free_points import CLEARANCE


def has_way(scene: Scene, size: tuple[float, float, float], radius: float, edge: float) -> bool:
    """As `sim.worlds.reachability.has_way`."""
    counts = [int(side / edge) for side in size]
    lower, upper = np.asarray(scene.volume, np.float64)
    free = np.zeros(counts, bool)
    for index in itertools.product(*map(range, counts)):
        point = lower + edge * (np.array(index) + 0.5)
        free[index] = point[2] < upper[2] and not any(_near(s, point, radius + edge / 2) for s in scene_shapes(scene))
    middles = lower + edge * (np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1) + 0.5)
    start, goal = (
        free & (np.linalg.norm(middles - np.asarray(point), axis=-1) < CLEARANCE - radius)
        for point in (scene.start, scene.goal)
    )
    parts = np.zeros(counts, np.int32)
    ndimage.label(free, output=parts)
    return bool(np.intersect1d(parts[start], parts[goal]).size)


def _near(shape, point: np.ndarray, need: float) -> bool:
    """Whether a point is within `need` of the upright prism around a shape, or below a level plane."""
    if isinstance(shape, Planes):
        return bool(shape.normal[2] * (point[2] - shape.position[2]) < need)
    x, y, z = point - shape.position
    if isinstance(shape, UprightBoxes):
        along = x * np.cos(shape.yaw) + y * np.sin(shape.yaw)
        across = y * np.cos(shape.yaw) - x * np.sin(shape.yaw)
        beyond = np.hypot(*np.maximum(np.abs([along, across]) - shape.half[:2], 0.0))
        half = shape.half[2]
    else:
        beyond = np.hypot(x, y) - shape.radius
        half = shape.half_height if isinstance(shape, UprightCylinders) else shape.radius
    return bool(beyond < need and abs(z) < half + need)
