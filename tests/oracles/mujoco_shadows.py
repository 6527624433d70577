"""Which of what rays meet the sun does not reach, by MuJoCo's own ray caster: a second ray from there, nothing else."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from tests.oracles.mujoco_depth import RayCaster

OFF_M = 2e-3
"""How far the second ray begins from the surface, back along the first: MuJoCo counts what begins on it as within."""


def in_shadow(world: RayCaster, origin: NDArray, directions: NDArray, sun: NDArray) -> NDArray[np.bool_]:
    """Returns whether anything is between the sun and what each of `directions` [..., 3] from `origin` meets."""
    rays = directions.reshape(-1, 3) / np.linalg.norm(directions.reshape(-1, 3), axis=1, keepdims=True)
    sun, geom, found = np.asarray(sun, np.float64), np.zeros(1, np.int32), np.zeros(len(rays), bool)
    for i, distance in enumerate(world.distance(origin, rays)):
        if np.isfinite(distance):
            point = np.asarray(origin, np.float64) + (distance - OFF_M) * rays[i]
            found[i] = mujoco.mj_ray(world.model, world.data, point, sun, None, 1, -1, geom) >= 0
    return found.reshape(directions.shape[:-1])
