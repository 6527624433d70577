"""A pilot with a policy, a vehicle and a camera of a few lines each, in virtual time."""

from __future__ import annotations

from typing import Any

import numpy as np

from edqn_jax.fly.faults import Inputs, Odometry, Settings
from edqn_jax.fly.link import Own
from edqn_jax.fly.machine import Output
from edqn_jax.fly.pilot import Pilot, Task
from edqn_jax.fly.streams import EVENT, Events
from edqn_jax.interop.deployment.runner import Command
from tests.support.virtual_flight import CAMERA, PERIOD_S, TICK_S, Vehicle

GOAL = np.array([12.0, 0.0, 5.0])
FENCE = np.array([[-5.0, -20.0, 0.0], [40.0, 20.0, 25.0]])
SETTINGS = Settings(goal=GOAL, fence=FENCE, camera=CAMERA, period_s=PERIOD_S)


class Time:
    """Virtual time."""

    passes = False

    def __init__(self) -> None:
        self.moment = 50.0

    def now(self) -> float:
        return self.moment

    def sleep_until(self, moment: float) -> None:
        assert moment <= self.moment + TICK_S + 1e-9
        self.moment = max(self.moment, moment)

    def work(self) -> None:
        self.moment += 0.004


class Policy:
    """Flies ahead; its move tells of the number of events."""

    period_s, window_us = PERIOD_S, 160_000
    about = {"frame_times_us": [-160_000, -80_000, 0]}

    def __init__(self, error: Exception | None = None) -> None:
        self.resets, self.error = 0, error

    def reset(self) -> None:
        self.resets += 1

    def count(self, packet: np.ndarray) -> None:
        """Counts nothing: it is given the events themselves."""

    def decide(self, packet: np.ndarray, until_us: int, **own: Any) -> Command:
        if self.error is not None:
            raise self.error
        assert np.asarray(own["attitudes"]).shape == (3, 4)
        return Command(packet.size % 27, np.array([3.0, 0.0, 0.0], np.float32), 0.25, np.zeros(27, np.float32))


class Wire:
    """`Link`, to a vehicle in virtual time."""

    def __init__(self, armed: bool = True) -> None:
        self.vehicle, self.said, self.sent, self.asked = Vehicle(np.array([0.0, 0.0, 5.0])), [], [], []
        self._now, self._armed = 0.0, armed

    def read(self, now: float) -> None:
        while self._now < now - 1e-9:
            self._now = now if now - self._now > 1.0 else self._now + TICK_S
            self.vehicle.move()

    def inputs(self) -> Inputs:
        own = Odometry(self._now, self.vehicle.position, self.vehicle.velocity)
        return Inputs(self._now, mode=self.vehicle.mode, armed=self._armed, airborne=self._armed, odometry=own)

    def own(self, now: float) -> Own:
        return Own(Odometry(now, self.vehicle.position, self.vehicle.velocity), np.array([1.0, 0, 0, 0]), 0.0)

    def attitude_at(self, time: float) -> np.ndarray:
        return np.array([1.0, 0, 0, 0])

    def send(self, velocity: Any, yaw: float | None, now: float) -> None:
        self.sent.append((now, velocity, yaw))
        self.vehicle.obey(Output(velocity), now)

    def request(self, mode: str) -> None:
        self.asked.append(mode)
        self.vehicle.obey(Output(request=mode), self._now)

    def forget_masters(self) -> None: ...


class Camera:
    def __init__(self, ends_at: float = np.inf) -> None:
        self.events, self._ends_at, self._random = Events(CAMERA), ends_at, np.random.default_rng(0)

    def read(self, now: float, least_us: int = -1) -> None:
        if now > self._ends_at:
            return
        until = round(1e6 * self.shows(now))
        events = np.zeros(int(self._random.integers(2000, 4000)), EVENT)
        events["t"], events["p"] = until - 1, 1
        self.events.add(events, until, now)

    def shows(self, now: float) -> float:
        """Returns seconds of its clock."""
        return now + 7.0

    def wait(self, most_s: float) -> None:
        raise AssertionError("virtual time does not pass while one waits")

    def close(self) -> None: ...


def make(
    policy: Any = None, wire: Any = None, camera: Any = None, clock: Time | None = None, **more: Any
) -> tuple[Pilot, Any]:
    wire = wire or Wire()
    known = {name: more.pop(name) for name in ("pace", "dry", "fov_deg", "contrast", "lens") if name in more}
    task = Task(more.pop("settings", SETTINGS), FENCE, **known)
    flier: Any = policy or Policy()
    pilot = Pilot(flier, wire, camera or Camera(), clock or Time(), task, tell=lambda _: None, **more)
    return pilot, wire
