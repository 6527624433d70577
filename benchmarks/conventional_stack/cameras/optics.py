"""What both cameras share: the lens, light and texture as plain numbers, and how a camera is called."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from conventional_stack.stopwatch import Stopwatch
from edqn_jax.config import CameraConfig
from edqn_jax.extras import require_extra
from edqn_jax.sim.camera.camera import LUMA_WEIGHTS
from edqn_jax.sim.camera.raycast import image_plane, pitch_of, sun_direction
from edqn_jax.sim.camera.texture import WAVES

numba = require_extra("numba")


class Optics(NamedTuple):
    """The camera as plain numbers."""

    u: NDArray[np.float64]  # [W] rightwards, at unit depth
    v: NDArray[np.float64]  # [H] upwards
    pitch: float
    ambient: float
    sun: NDArray[np.float64]  # [3] unit
    sky: float  # luma
    waves: NDArray[np.float64]  # [4, 3] cycles per metre
    weights: NDArray[np.float64]  # [4] contrast of each


def optics_of(config: CameraConfig) -> Optics:
    """Returns the camera of a configuration."""
    u, v = image_plane(config, 1, 1)
    per_metre = [np.array(wave.direction) / (config.texture_period_m * wave.octave) for wave in WAVES]
    return Optics(
        u=u.astype(np.float64),
        v=v.astype(np.float64),
        pitch=pitch_of(config),
        ambient=config.ambient,
        sun=np.array(sun_direction(config)),
        sky=float(np.dot(config.sky_rgb, LUMA_WEIGHTS)),
        waves=np.array(per_metre),
        weights=config.texture_contrast * np.array([wave.weight for wave in WAVES]),
    )


@numba.njit(cache=True, inline="always")
def heading_of(pose):
    """Returns cosine and sine of the heading of a pose [7]."""
    w, z = pose[3], pose[6]
    scale = 1.0 / max(w * w + z * z, 1e-9)
    return (w * w - z * z) * scale, 2 * w * z * scale


class Camera(Protocol):
    """Draws two frames of up to `block` drones at a time."""

    block: int
    """Drones whose frames are drawn together, so that they stay in the cache."""

    def draw(
        self,
        stopwatch: Stopwatch,
        poses: NDArray[np.float64],
        luma: NDArray[np.float64],
        label: NDArray[np.float32] | None,
    ) -> None:
        """Draws frames at poses [2, M, 7], and if wanted the label of the second one.

        Args:
            poses: positions and quaternions; roll and pitch are removed.
            luma: [2, M, H x W] linear, output.
            label: [M, H x W] `edqn_jax.sim.sensors.sensor.nearness_image`, output.
        """
        ...
