"""How PX4 answers a computer that wants to steer it: modes, arming, and when it leaves offboard mode by itself."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3
"""MAV_RESULT."""

OFFBOARD, HOLD, LAND, POSITION = (6, 0), (4, 3), (4, 6), (3, 0)
"""Main and sub mode."""


@dataclasses.dataclass(frozen=True)
class Limits:
    """Parameters of PX4 with their defaults, but for the last three, which a policy of 4 m/s needs so.

    Largest thrust, jerk and accelerations up and down have no limits of their own here.
    """

    COM_OF_LOSS_T: float = 0.5
    """Seconds without a setpoint after which offboard mode is left."""
    MPC_XY_VEL_MAX: float = 12.0
    """m/s."""
    MPC_ACC_HOR_MAX: float = 5.0
    """m/s², here of the held velocity's change in any direction; PX4's is of level flight."""
    MPC_TILTMAX_AIR: float = 45.0
    """Degrees."""
    MPC_THR_MIN: float = 0.12
    """Least thrust, a share of the largest."""
    MPC_THR_HOVER: float = 0.5
    """Thrust that holds the weight, likewise."""
    MPC_LAND_SPEED: float = 0.7
    """m/s."""
    MPC_YAWRAUTO_MAX: float = 114.6
    """Degrees a second: the 2 rad/s of our training; PX4's own is 45."""
    MPC_Z_VEL_MAX_UP: float = 4.0
    """m/s; PX4's default is 3."""
    MPC_Z_VEL_MAX_DN: float = 4.0
    """m/s; PX4's default is 1.5."""

    def limit(self, velocity: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns a velocity [3] m/s, z up, within the limits of speed."""
        across = float(np.hypot(velocity[0], velocity[1]))
        share = min(1.0, self.MPC_XY_VEL_MAX / max(across, 1e-9))
        up = float(np.clip(velocity[2], -self.MPC_Z_VEL_MAX_DN, self.MPC_Z_VEL_MAX_UP))
        return np.array([share * velocity[0], share * velocity[1], up])

    def of_body(self) -> dict[str, float]:
        """Returns what `RotorPyBody` is given of these."""
        return {
            "setpoint_m_s2": self.MPC_ACC_HOR_MAX,
            "max_tilt_rad": math.radians(self.MPC_TILTMAX_AIR),
            "least_thrust": self.MPC_THR_MIN / self.MPC_THR_HOVER,
        }


class Manners:
    """Mode and setpoint of a vehicle; times are seconds of its own clock."""

    def __init__(self, limits: Limits, *, armed: bool = True, airborne: bool = True) -> None:
        self.limits = limits
        self.mode: tuple[int, int] = HOLD
        self.armed, self.airborne = armed, airborne
        self._velocity, self._yaw = np.zeros(3), 0.0
        self._setpoints: list[float] = []

    def take_setpoint(self, velocity: NDArray[np.float64], yaw: float, now: float) -> None:
        """Takes a setpoint of velocity [3] m/s, z up, and heading, radians."""
        if np.all(np.isfinite(velocity)) and np.isfinite(yaw):
            self._velocity, self._yaw = velocity, yaw
            self._setpoints = [*(at for at in self._setpoints if at > now - 1.0), now]

    def take_mode(self, mode: tuple[int, int], now: float) -> int:
        """Returns the MAV_RESULT of a wish for a mode: offboard only while setpoints come, at 2 Hz or more."""
        if mode == OFFBOARD and not self._has_setpoints(now):
            return TEMPORARILY_REJECTED
        if mode not in (OFFBOARD, HOLD, LAND, POSITION):
            return UNSUPPORTED
        self.mode = mode
        return ACCEPTED

    def take_arming(self, armed: bool) -> int:
        """Returns the MAV_RESULT of a wish to arm or disarm; in the air nothing is disarmed."""
        if not armed and self.airborne:
            return DENIED
        self.armed = armed
        return ACCEPTED

    def wanted(self, now: float, yaw: float, height_m: float) -> tuple[NDArray[np.float64], float]:
        """Returns velocity [3] m/s and heading that are flown now; leaves offboard mode without setpoints.

        Args:
            now: seconds.
            yaw: heading now, radians.
            height_m: above the ground.
        """
        if self.mode == OFFBOARD and not self._has_setpoints(now):
            self.mode = HOLD
        if self.mode == LAND and height_m <= 0.0:
            self.armed = self.airborne = False
        if not self.airborne or not self.armed:
            return np.zeros(3), yaw
        if self.mode == OFFBOARD:
            return self.limits.limit(self._velocity), self._yaw
        if self.mode == LAND:
            return np.array([0.0, 0.0, -self.limits.MPC_LAND_SPEED]), yaw
        return np.zeros(3), yaw

    def _has_setpoints(self, now: float) -> bool:
        recent = [at for at in self._setpoints if at > now - 1.0]
        return len(recent) >= 2 and now - recent[-1] <= self.limits.COM_OF_LOSS_T
