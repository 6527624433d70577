"""A vehicle and a camera in virtual time, to whom faults happen."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from edqn_jax.fly.faults import Command, Inputs, Odometry, Settings
from edqn_jax.fly.machine import Output, Phase, State, step

TICK_S = 0.02
PERIOD_S = 0.26
CAMERA = (346, 260)

Change = Callable[[Inputs, float], Inputs]
"""What a fault does to what is heard, so many seconds after it began."""


@dataclasses.dataclass
class Vehicle:
    """A point that follows setpoints with a lag, and obeys modes as PX4 does."""

    position: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    velocity: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    mode: str = "hold"
    wanted: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    setpoint_at: float | None = None
    airborne: bool = True

    def obey(self, output: Output, now: float) -> None:
        if output.velocity is not None:
            self.wanted, self.setpoint_at = np.array(output.velocity), now
        if self.mode == "offboard" and (self.setpoint_at is None or now - self.setpoint_at > 0.5):
            self.mode = "hold"
        if output.request is not None:
            self.mode = output.request

    def move(self) -> None:
        goes = self.wanted if self.mode == "offboard" else np.array([0.0, 0.0, -2.0 * (self.mode == "land")])
        self.velocity = self.velocity + (goes - self.velocity) * min(1.0, 4.5 * TICK_S)
        self.position = self.position + self.velocity * TICK_S
        if self.mode == "land" and self.position[2] <= 0.0:
            self.airborne = False


@dataclasses.dataclass
class Flown:
    """What happened."""

    state: State
    times: np.ndarray
    setpoints: list[tuple[float, float, float] | None]
    phases: list[Phase]
    vehicle: Vehicle

    def moves_after(self, time: float) -> bool:
        """Returns whether a setpoint other than zero was sent from a time on."""
        late = [each for at, each in zip(self.times, self.setpoints, strict=True) if at >= time]
        return any(each is not None and any(each) for each in late)


def _towards(goal: np.ndarray, place: np.ndarray) -> np.ndarray:
    way = goal - place
    return 3.0 * way / np.linalg.norm(way)


def fly(
    settings: Settings,
    fault: Change | None = None,
    at: float = np.inf,
    *,
    lasts: float = np.inf,
    seconds: float = 40.0,
    decide: Callable[[Vehicle], np.ndarray] | None = None,
    seed: int = 0,
    height: float = 5.0,
) -> Flown:
    """Flies through virtual time; a fault changes what is heard for so long from a time on."""
    rng = np.random.default_rng(seed)
    vehicle, state, inputs = Vehicle(np.array([0.0, 0.0, height])), State(), Inputs()
    decided, setpoints, phases, times = -np.inf, [], [], []
    decide = decide or (lambda drone: _towards(settings.goal, drone.position))
    heartbeat = -np.inf
    for tick in range(round(seconds / TICK_S)):
        now = tick * TICK_S
        if now - heartbeat >= 1.0:
            heartbeat = now
        place = vehicle.position + rng.normal(0, 0.02, 3)
        true = Inputs(
            heartbeat_at=heartbeat,
            mode=vehicle.mode,
            armed=True,
            airborne=vehicle.airborne,
            odometry=Odometry(now - 0.01, place, vehicle.velocity + rng.normal(0, 0.05, 3)),
            packet_at=now - 0.004,
            rate_hz=2e5,
            camera=CAMERA,
            battery=0.8,
            command=inputs.command,
        )
        inputs = fault(true, now - at) if fault is not None and at <= now < at + lasts else true
        state, output = step(state, inputs, now, settings)
        if output.decides and now - decided >= PERIOD_S - 1e-9:
            decided = now
            inputs = dataclasses.replace(inputs, command=Command(now, decide(vehicle), 0.0))
        vehicle.obey(output, now)
        vehicle.move()
        times.append(now)
        setpoints.append(output.velocity)
        phases.append(state.phase)
        if state.phase is Phase.ENDED:
            break
    return Flown(state, np.array(times), setpoints, phases, vehicle)
