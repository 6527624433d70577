"""Depth by MuJoCo's own ray caster, on the scene's MJCF."""

from __future__ import annotations

import tempfile
from pathlib import Path

import mujoco
import numpy as np

from edqn_jax.sim.scene.mjcf import write_scene
from edqn_jax.sim.scene.scene import Scene


class RayCaster:
    """One scene, compiled by MuJoCo."""

    def __init__(self, scene: Scene):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scene.xml"
            write_scene(scene, path)
            self.model = mujoco.MjModel.from_xml_path(str(path))
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)

    def distance(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Metres along each of `directions` [..., 3] to what it meets first, inf if nothing."""
        rays = directions.reshape(-1, 3).astype(np.float64)
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        found, geom = np.empty(len(rays)), np.zeros(1, np.int32)
        for i, ray in enumerate(rays):
            found[i] = mujoco.mj_ray(self.model, self.data, np.asarray(origin, np.float64), ray, None, 1, -1, geom)
        return np.where(found < 0, np.inf, found).reshape(directions.shape[:-1])
