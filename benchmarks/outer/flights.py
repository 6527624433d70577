"""How a command becomes motion: the package's own flight, or RotorPy's dynamics under its SE3 controller."""

from __future__ import annotations

import contextlib
import dataclasses
import io
from typing import Any, Protocol

import jax
import numpy as np
from numpy.typing import NDArray

from edqn_jax.extras import require_extra
from edqn_jax.interop.deployment.runner import Command
from edqn_jax.sim.environment import Environment
from edqn_jax.sim.physics import drone
from outer.poses import Track

KINDS = ("own", "rotorpy", "rotorpy-steps")
"""Who flies. `rotorpy-steps`: its controller's setpoint jumps with each command."""

ROTORPY_STEP_S = 0.005
"""How often RotorPy's controller acts."""

SETPOINT_M_S2 = 8.0
"""How fast the velocity changes that RotorPy's controller is given, as an autopilot limits it."""


@dataclasses.dataclass(frozen=True)
class Body:
    """What a drone knows of itself at a decision."""

    position: NDArray[np.float64]
    """[3] metres."""
    quaternion: NDArray[np.float64]
    """[4] w, x, y, z, from the body to the world."""
    velocity: NDArray[np.float64]
    """[3] m/s in the world."""
    yaw_rate: float
    """Of the heading, rad/s to the left."""


class Flight(Protocol):
    """A drone that flies one mission."""

    def body(self) -> Body:
        """Returns what it knows of itself now."""
        ...

    def fly(self, command: Command, seconds: float) -> Track:
        """Flies a command and returns the poses after each physics step; times count from the command."""
        ...


class OwnFlight:
    """The package's physics and controller, one decision after another."""

    def __init__(self, environment: Environment, mission: int) -> None:
        self._environment = environment
        self._state, _ = environment.reset(0, mission)

    def body(self) -> Body:
        """Returns what the drone knows of itself now."""
        body = self._state.drone
        place, attitude, speed = (
            np.asarray(each, np.float64) for each in (body.position, body.quaternion, body.velocity)
        )
        return Body(place, attitude, speed, float(drone.yaw_rate_of(body)))

    def fly(self, command: Command, seconds: float) -> Track:
        """Flies one decision of the environment."""
        self._state, step = self._environment.step(self._state, command.move)
        position, quaternion = (np.asarray(each, np.float64) for each in (step.flight.position, step.flight.quaternion))
        time = seconds * np.arange(1, len(position) + 1) / len(position)
        return Track(time, position, quaternion)


class RotorPyFlight:
    """RotorPy's quadrotor with drag and motor lag, flown by its SE3 controller with the velocity as its reference.

    The reference's position is where the drone is, so that the controller follows the velocity alone: in proportion,
    since it has no integral part, and drag takes its share. It knows no limit of acceleration: a velocity that jumps
    by 8 m/s tilts the drone by 80 degrees and turns it by up to 180, so the reference changes by `SETPOINT_M_S2`.
    """

    def __init__(
        self, start: NDArray[np.float64], goal: NDArray[np.float64], max_yaw_rate: float, setpoint_m_s2: float
    ) -> None:
        vehicles = require_extra("rotorpy.vehicles.multirotor", extra="transfer")
        control = require_extra("rotorpy.controllers.quadrotor_control", extra="transfer")
        self._params: dict[str, Any] = require_extra(
            "rotorpy.vehicles.hummingbird_params", extra="transfer"
        ).quad_params
        self._control = control.SE3Control(self._params)
        half = np.arctan2(goal[1] - start[1], goal[0] - start[0]) / 2
        hover = np.sqrt(self._params["mass"] * 9.81 / 4 / self._params["k_eta"])
        self._state: dict[str, Any] = {
            "x": np.array(start, np.float64),
            "v": np.zeros(3),
            "q": np.array([0.0, 0.0, np.sin(half), np.cos(half)]),
            "w": np.zeros(3),
            "wind": np.zeros(3),
            "rotor_speeds": np.full(4, hover),
        }
        with contextlib.redirect_stdout(io.StringIO()):
            self._vehicle = vehicles.Multirotor(self._params, self._state, control_abstraction="cmd_motor_speeds")
        self._yaw, self._max_yaw_rate = 2 * half, max_yaw_rate
        self._velocity, self._setpoint_m_s2 = np.zeros(3), setpoint_m_s2

    def body(self) -> Body:
        """Returns what the drone knows of itself now."""
        x, y, z, w = self._state["q"]
        quaternion = np.array([w, x, y, z])
        _, pitch_rate, yaw_rate = self._state["w"]
        # The heading's rate from body rates, by the angles of a z-y-x rotation.
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
        rate = (np.sin(roll) * pitch_rate + np.cos(roll) * yaw_rate) / max(np.cos(pitch), 0.1)
        return Body(self._state["x"].copy(), quaternion, self._state["v"].copy(), float(rate))

    def fly(self, command: Command, seconds: float) -> Track:
        """Holds the command's velocity; the heading turns to the command's, at most at the largest rate."""
        times, positions, quaternions = [], [], []
        most = self._max_yaw_rate * ROTORPY_STEP_S
        for step in range(round(seconds / ROTORPY_STEP_S)):
            short = np.angle(np.exp(1j * (command.yaw - self._yaw)))
            self._yaw += float(np.clip(short, -most, most))
            change = np.asarray(command.velocity, np.float64) - self._velocity
            size = max(float(np.linalg.norm(change)), 1e-9)
            self._velocity = self._velocity + change * min(1.0, self._setpoint_m_s2 * ROTORPY_STEP_S / size)
            wanted = {
                "x": self._state["x"],
                "x_dot": self._velocity,
                "x_ddot": np.zeros(3),
                "yaw": self._yaw,
                "yaw_dot": 0.0,
            }
            control = self._control.update(step * ROTORPY_STEP_S, self._state, wanted)
            self._state = self._vehicle.step(self._state, control, ROTORPY_STEP_S)
            x, y, z, w = self._state["q"]
            times.append((step + 1) * ROTORPY_STEP_S)
            positions.append(self._state["x"].copy())
            quaternions.append([w, x, y, z])
        return Track(np.array(times), np.array(positions), np.array(quaternions))


def start_flight(kind: str, environment: Environment, mission: int, max_yaw_rate: float) -> Flight:
    """Returns a drone at rest at a mission's start, facing the goal; `kind` is one of `KINDS`.

    Raises:
        MissingPackageError: if RotorPy is not installed.
    """
    if kind == "own":
        return OwnFlight(environment, mission)
    limit = np.inf if kind == "rotorpy-steps" else SETPOINT_M_S2
    scene = jax.tree.map(np.asarray, environment.scene(mission))
    return RotorPyFlight(np.asarray(scene.start, np.float64), np.asarray(scene.goal, np.float64), max_yaw_rate, limit)
