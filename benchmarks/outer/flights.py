"""How a command becomes motion: the package's own flight, or RotorPy's dynamics under its SE3 controller."""

from __future__ import annotations

from typing import Protocol

import jax
import numpy as np
from numpy.typing import NDArray

from edqn_jax.fly.simulated.manners import Limits
from edqn_jax.interop.deployment.runner import Command
from edqn_jax.interop.outer.poses import Body, Track
from edqn_jax.interop.outer.rotorpy_body import STEP_S, RotorPyBody
from edqn_jax.sim.environment import Environment
from edqn_jax.sim.physics import drone

KINDS = ("own", "rotorpy", "rotorpy-px4", "rotorpy-steps")
"""Who flies. `rotorpy-px4`: with PX4's limits of acceleration, tilt and least thrust, the vehicle of
`edqn fly --simulate`. `rotorpy-steps`: its controller's setpoint jumps with each command."""

SETPOINT_M_S2 = 8.0
"""How fast the velocity changes that RotorPy's controller is given, as an autopilot limits it."""


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
    """RotorPy's quadrotor, whose setpoints change by at most `setpoint_m_s2` and turn at most at the largest rate."""

    def __init__(
        self,
        start: NDArray[np.float64],
        goal: NDArray[np.float64],
        max_yaw_rate: float,
        setpoint_m_s2: float,
        **limits: float,
    ) -> None:
        yaw = float(np.arctan2(goal[1] - start[1], goal[0] - start[0]))
        self._body = RotorPyBody(start, yaw, max_yaw_rate, setpoint_m_s2, **limits)

    def body(self) -> Body:
        """Returns what it knows of itself now."""
        return self._body.state()

    def fly(self, command: Command, seconds: float) -> Track:
        """Holds the command's velocity; the heading turns to the command's."""
        times, bodies = [], []
        for step in range(round(seconds / STEP_S)):
            self._body.step(command.velocity, command.yaw)
            times.append((step + 1) * STEP_S)
            bodies.append(self._body.state())
        return Track(np.array(times), np.array([b.position for b in bodies]), np.array([b.quaternion for b in bodies]))


def start_flight(kind: str, environment: Environment, mission: int, max_yaw_rate: float) -> Flight:
    """Returns a drone at rest at a mission's start, facing the goal; `kind` is one of `KINDS`.

    Raises:
        MissingPackageError: if RotorPy is not installed.
    """
    if kind == "own":
        return OwnFlight(environment, mission)
    limits = {"setpoint_m_s2": np.inf if kind == "rotorpy-steps" else SETPOINT_M_S2}
    if kind == "rotorpy-px4":
        limits = Limits().of_body()
    scene = jax.tree.map(np.asarray, environment.scene(mission))
    start, goal = np.asarray(scene.start, np.float64), np.asarray(scene.goal, np.float64)
    return RotorPyFlight(start, goal, max_yaw_rate, **limits)
