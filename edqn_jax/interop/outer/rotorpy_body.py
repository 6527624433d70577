"""RotorPy's quadrotor with drag and motor lag, flown by its SE3 controller along setpoints of velocity and heading."""

from __future__ import annotations

import contextlib
import io
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edqn_jax.extras import require_extra
from edqn_jax.interop.outer.poses import Body

STEP_S = 0.005
"""How often RotorPy's controller acts."""


class RotorPyBody:
    """RotorPy's Hummingbird, hovering at first.

    The controller's reference position is where the drone is, so that it follows the velocity alone: in proportion,
    since it has no integral part, and drag takes its share. It knows no limit of acceleration: a velocity that jumps
    by 8 m/s tilts the drone by 80 degrees and turns it by up to 180, so the reference changes by `setpoint_m_s2`. Nor
    does it keep the thrust upwards: a descent that is faster than a fall turns the drone upside down, unless its tilt
    is limited as an autopilot limits it.
    """

    def __init__(
        self,
        start: ArrayLike,
        yaw: float,
        max_yaw_rate: float,
        setpoint_m_s2: float,
        *,
        max_tilt_rad: float | None = None,
        least_thrust: float = 0.0,
        wind: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        """Prepares a drone at rest.

        Args:
            start: [3] metres.
            yaw: radians from x to the left.
            max_yaw_rate: of its setpoint, rad/s.
            setpoint_m_s2: how fast the velocity changes that the controller is given, as an autopilot limits it.
            max_tilt_rad: of the thrust that is asked of the controller; None: it asks for any.
            least_thrust: that is kept upwards where the tilt is limited, as a share of the weight; comes before
                what is asked sideways.
            wind: [3] m/s.

        Raises:
            MissingPackageError: if RotorPy is not installed.
        """
        vehicles = require_extra("rotorpy.vehicles.multirotor", extra="fly")
        control = require_extra("rotorpy.controllers.quadrotor_control", extra="fly")
        params = require_extra("rotorpy.vehicles.hummingbird_params", extra="fly").quad_params
        self._control = control.SE3Control(params)
        hover = np.sqrt(params["mass"] * self._control.g / 4 / params["k_eta"])
        self._state: dict[str, Any] = {
            "x": np.array(start, np.float64),
            "v": np.zeros(3),
            "q": np.array([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]),
            "w": np.zeros(3),
            "wind": np.array(wind, np.float64),
            "rotor_speeds": np.full(4, hover),
        }
        with contextlib.redirect_stdout(io.StringIO()):
            self._vehicle = vehicles.Multirotor(params, self._state, control_abstraction="cmd_motor_speeds")
        self._yaw, self._max_yaw_rate = yaw, max_yaw_rate
        self._velocity, self._setpoint_m_s2 = np.zeros(3), setpoint_m_s2
        self._max_tilt_rad, self._least_thrust = max_tilt_rad, least_thrust

    def state(self) -> Body:
        """Returns position, attitude, velocity and yaw rate now."""
        x, y, z, w = self._state["q"]
        quaternion = np.array([w, x, y, z])
        _, pitch_rate, yaw_rate = self._state["w"]
        # The heading's rate from body rates, by the angles of a z-y-x rotation.
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
        rate = (np.sin(roll) * pitch_rate + np.cos(roll) * yaw_rate) / max(np.cos(pitch), 0.1)
        return Body(self._state["x"].copy(), quaternion, self._state["v"].copy(), float(rate))

    def step(self, velocity: ArrayLike, yaw: float) -> None:
        """Flies `STEP_S` seconds towards a velocity [3], m/s in the world, and a heading, radians."""
        most = self._max_yaw_rate * STEP_S
        self._yaw += float(np.clip(np.angle(np.exp(1j * (yaw - self._yaw))), -most, most))
        change = np.asarray(velocity, np.float64) - self._velocity
        size = max(float(np.linalg.norm(change)), 1e-9)
        self._velocity = self._velocity + change * min(1.0, self._setpoint_m_s2 * STEP_S / size)
        wanted = {
            "x": self._state["x"],
            "x_dot": self._within_limits(self._velocity),
            "x_ddot": np.zeros(3),
            "yaw": self._yaw,
            "yaw_dot": 0.0,
        }
        control = self._control.update(0.0, self._state, wanted)
        self._state = self._vehicle.step(self._state, control, STEP_S)

    def _within_limits(self, velocity: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns a velocity whose error asks for a thrust within the limits; sideways gives way to upwards."""
        if self._max_tilt_rad is None:
            return velocity
        gain, weight = self._control.kd_pos, self._control.g  # thrusts per mass
        error = velocity - self._state["v"]
        upwards = max(gain[2] * error[2] + weight, self._least_thrust * weight)
        across = max(float(np.linalg.norm(gain[:2] * error[:2])), 1e-9)
        share = min(1.0, np.tan(self._max_tilt_rad) * upwards / across)
        error = np.array([share * error[0], share * error[1], (upwards - weight) / gain[2]])
        return self._state["v"] + error
