"""A flight beside a box, and pictures of it that need no compiling."""

from __future__ import annotations

import dataclasses
import io
from typing import Any

import numpy as np
from PIL import Image

from edqn_jax.config import CameraConfig
from edqn_jax.learn.policy import fresh_policy
from edqn_jax.report.animation import Film, animate_flight
from edqn_jax.report.sights import FINE, SensorImages
from edqn_jax.sim.scene.scene import Planes, Scene, UprightBoxes, build_scene
from tests.support.policies import CONFIG

SMALL = dataclasses.replace(
    CONFIG, camera=CameraConfig(), drone=dataclasses.replace(CONFIG.drone, physics="rigid_body")
)


def world_with_a_box() -> Scene:
    shapes = [
        UprightBoxes(*map(np.asarray, ([12.0, 1, 4], [2.0, 2, 4], 0.3, [0.9] * 3))),  # pyright: ignore
        Planes(*map(np.asarray, ([0.0] * 3, [0.0, 0, 1], [0.4] * 3))),  # pyright: ignore
    ]
    return build_scene(shapes, volume=[[-9, -9, 0], [40, 9, 20]], start=[0, 0, 4], goal=[30, 0, 4])


class Drawn:
    """Sights that need no compiling."""

    config, scene, has_image = SMALL, world_with_a_box(), True

    def rgb(self, position: np.ndarray, quaternion: np.ndarray, time: np.ndarray) -> np.ndarray:
        return np.full((SMALL.camera.height * FINE, SMALL.camera.width * FINE, 3), 0.2 + 0.02 * position[0])

    def shown(self, params: object, flown: dict[str, np.ndarray]) -> SensorImages:
        counts = np.random.default_rng(0).integers(-3, 4, (len(flown["t"]) // 13, 24, 32))
        return SensorImages(counts, counts, counts, counts)


def a_flight(decisions: float) -> dict[str, np.ndarray]:
    t = 0.02 * np.arange(1, round(13 * decisions) + 1)
    still = dict.fromkeys(("y", "qx", "qy", "qz", "vy", "vz"), 0 * t)
    return {"t": t, "x": t, "z": 0 * t + 4, "qw": 0 * t + 1, "vx": 0 * t + 1} | still


def recorded(sights: Any, decisions: float, outcome: str = "goal", film: Film = Film()) -> Image.Image:  # noqa: B008
    gif = animate_flight(sights, fresh_policy(SMALL), a_flight(decisions), outcome, title="a box", film=film)
    return Image.open(io.BytesIO(gif))
