"""The drone's inner loops in plain Python, one drone and one physics step at a time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edqn_jax.config import DroneConfig
from edqn_jax.sim.physics.controller import LEAST_LEVELNESS

Vector = NDArray[np.float64]


def thrusts(
    config: DroneConfig,
    mass: float,
    inertia: Vector,
    mixer: Vector,
    most: float,
    gravity: float,
    pose: Vector,
    motion: Vector,
    velocity: Vector,
    yaw: float,
) -> Vector:
    """Returns rotor thrusts [4] newtons as `edqn_jax.sim.physics.controller.rotor_thrusts`.

    Loops of velocity, tilt, body rates and torque.

    Args:
        config: gains and limits.
        mass, inertia, mixer, most, gravity: kg, [3] kg m^2, [4, 4], newtons, m/s^2, as in `Airframe`.
        pose: MuJoCo's qpos [7].
        motion: MuJoCo's qvel [6].
        velocity: commanded, [3] m/s (world).
        yaw: heading setpoint, radians.
    """
    w, x, y, z = pose[3:]
    error, rates = velocity - motion[:3], motion[3:]

    climb = np.clip(config.climb_gain * error[2], -config.max_descent_m_s2, config.max_climb_m_s2)
    force = np.array([config.velocity_gain * error[0], config.velocity_gain * error[1], gravity + climb])
    limit = min(config.max_horizontal_m_s2, math.tan(config.max_tilt_rad) * force[2])
    force[:2] *= min(1.0, limit / math.sqrt(force[0] ** 2 + force[1] ** 2 + 1e-9))

    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    missing = rotation.T @ force / np.linalg.norm(force)
    gain = min(
        config.attitude_gain / math.sqrt(max(0.5 + 0.5 * missing[2], 1e-2)),
        config.max_body_rate_rad_s / math.sqrt(missing[0] ** 2 + missing[1] ** 2 + 1e-9),
    )
    cos, sin = math.cos(yaw / 2), math.sin(yaw / 2)
    ahead, aside = w * cos + z * sin, w * sin - z * cos
    turn = 2 * config.yaw_gain * aside * np.sign(ahead) / math.sqrt(w * w + z * z + 1e-6)
    turn = np.clip(turn, -config.max_yaw_rate_rad_s, config.max_yaw_rate_rad_s)
    wanted = np.array([-gain * missing[1], gain * missing[0], turn])

    gains = np.array([config.rate_gain, config.rate_gain, config.yaw_rate_gain])
    torque = inertia * gains * (wanted - rates) + np.cross(rates, inertia * rates)
    upright = rotation[2, 2]
    collective = mass * force[2] * max(upright, 0.0) / max(upright**2, LEAST_LEVELNESS**2)

    tilting = mixer[:, 1] * torque[0] + mixer[:, 2] * torque[1]
    scale = min(1.0, config.max_tilt_share * most / (tilting.max() - tilting.min() + 1e-9))
    shared = np.clip(mixer[0, 0] * collective, -scale * tilting.min(), most - scale * tilting.max())
    levelled = shared + scale * tilting
    margin = max(0.0, np.minimum(levelled, most - levelled).min())
    turning = np.clip(abs(mixer[0, 3]) * torque[2], -margin, margin)
    return np.clip(levelled + np.sign(mixer[:, 3]) * turning, 0.0, most)
