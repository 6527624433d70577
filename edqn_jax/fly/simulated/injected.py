"""What is made to go wrong in a simulated flight: to camera, vehicle or autopilot, at a moment, until its end."""

from __future__ import annotations

import signal
import subprocess
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edqn_jax.fly.faults import Fault
from edqn_jax.fly.link import mavlink
from edqn_jax.fly.streams import EVENT

KILLED = "process killed"
"""SIGKILL: the one that the state machine cannot answer."""

OF_CAMERA = (Fault.NO_EVENTS, Fault.BURST, Fault.COVERED)
OF_VEHICLE = (
    *(Fault.STALE, Fault.JUMP, Fault.DRIFT, Fault.LOST_LINK, Fault.SECOND_MASTER, Fault.TAKEN_OVER),
    Fault.BATTERY,
)
OF_AUTOPILOT = {Fault.STOPPED: signal.SIGTERM, KILLED: signal.SIGKILL}

FAULTS: tuple[str, ...] = (*map(str, (*OF_CAMERA, *OF_VEHICLE, Fault.FENCE, Fault.STOPPED)), KILLED)
"""All that can be asked for."""

COVERING_S = 0.02
"""A lens that is covered has a third of its light after so long."""

BURST_HZ = 1.2e7
"""Events per second of all pixels together."""

JUMP_M, DRIFT_M_S = 3.0, 2.0
"""Of the estimated position; to a side that is drawn."""

LEFT = 0.1
"""Share of a battery that is suddenly low."""

MASTER_S = 0.1
"""From one setpoint of a second master to the next."""

FENCE_M = 1.0
"""A fence that is to be reached goes so far around start and goal."""


def moment_of(between_s: tuple[float, float], number: int) -> float:
    """Returns when a mission's fault strikes, simulated seconds: drawn between two, for each mission once."""
    return float(np.random.default_rng([number, 47]).uniform(*between_s))


def fence_of(start: ArrayLike, goal: ArrayLike, volume: ArrayLike) -> NDArray[np.float64]:
    """Returns a fence [2, 3] that a way around something leaves: start and goal lie inside, by `FENCE_M` at most."""
    ends = np.array([start, goal], np.float64)
    around = np.stack([ends.min(0) - FENCE_M, ends.max(0) + FENCE_M])
    low, high = np.asarray(volume, np.float64)
    return np.clip(around, low, high)


def strike(process: subprocess.Popen, fault: str) -> None:
    """Stops or kills the autopilot's process, if that is what the fault is."""
    if (sent := OF_AUTOPILOT.get(fault)) is not None and process.poll() is None:
        process.send_signal(sent)


class CameraFault:
    """What a camera sends instead."""

    def __init__(self, fault: str | None, size: tuple[int, int], frame_s: float, seed: int) -> None:
        """Prepares what goes wrong.

        Args:
            fault: of `FAULTS`; None, or one of vehicle or autopilot, leaves the camera alone.
            size: pixels across and down.
            frame_s: from one packet to the next.
            seed: of a burst's pixels.
        """
        self._fault, self._size, self._frame_s = fault, size, frame_s
        self._random = np.random.default_rng(seed)

    def light(self, late_s: float) -> float:
        """Returns the share of the light that comes through the lens, so long after the fault began."""
        return float(np.exp(-max(late_s, 0.0) / COVERING_S)) if self._fault == Fault.COVERED else 1.0

    def sent(self, until_us: int, events: NDArray, late_s: float) -> NDArray | None:
        """Returns the packet [N] that is sent in place of these events; None sends none."""
        if late_s < 0.0 or self._fault not in (Fault.NO_EVENTS, Fault.BURST):
            return events
        if self._fault == Fault.NO_EVENTS:
            return None
        many = np.empty(round(BURST_HZ * self._frame_s), EVENT)
        many["x"], many["y"] = (self._random.integers(0, pixels, len(many)) for pixels in self._size)
        many["p"] = self._random.integers(0, 2, len(many)) * 2 - 1
        many["t"] = until_us - 1
        return many


def second_master() -> bytes:
    """Returns a setpoint of zero velocity of a ground station, as a vehicle forwards it."""
    dialect: Any = mavlink().mavlink
    station = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    still = dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0b1001_1100_0111, *(0.0,) * 11)
    return bytes(still.pack(station))
