"""Events of a camera along a flight: of a pair of frames (Eq. 2-5), of evlib's ESIM, or of v2e's emulator."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from edqn_jax.config import EventsConfig
from edqn_jax.extras import MissingPackageError, require_extra
from edqn_jax.interop.outer.pictures import See
from edqn_jax.interop.outer.poses import Track, camera_rotation
from edqn_jax.sim.sensors.event_field import STREAM_DTYPE

WIDE, HIGH = 346, 260
"""Pixels of the cameras of `esim` and `v2e`: a DAVIS346."""

CONTRAST = 0.2
"""Change of log brightness that makes one of their events."""

FRAME_S = 0.005
"""Seconds between the frames that they are given."""

LEAD_S = 0.02
"""Before a window frames are given, too: the first has the change of the gap since the window before it."""

EPSILON = 1e-3
"""Darkest brightness of which they take the logarithm."""


class EventCamera(Protocol):
    """A camera that makes the events of one flight."""

    def watch(self, track: Track, since: float, until: float) -> NDArray:
        """Returns the events in [since, until), seconds of the track: `STREAM_DTYPE`, microseconds of the track."""
        ...


class PairCamera:
    """The policy's own law between frames at its own times: the paper's Eq. 2-5.

    Pixels of which many stand for one of the policy's (`events.sensor_pixels`) have reference levels anywhere between
    two of their events.
    """

    def __init__(self, law: EventsConfig, see: See, mount: str) -> None:
        self._law, self._see, self._mount = law, see, mount
        self._phases = np.random.default_rng(0)

    def watch(self, track: Track, since: float, until: float) -> NDArray:
        """Returns the events between the frames before `until`."""
        times = until + np.asarray(self._law.frame_times_s)
        frames = [_log(see_at(self._see, track, time, self._mount), self._law.log_epsilon) for time in times]
        packets = []
        for before, after, first, last in zip(frames, frames[1:], times, times[1:], strict=False):
            change = after - before
            count = self._count(np.abs(change))
            row, column = np.nonzero(count)
            many = count[row, column]
            order = np.concatenate([np.arange(n) for n in many]) if len(many) else np.zeros(0)
            packet = np.empty(int(many.sum()), STREAM_DTYPE)
            packet["t"] = np.floor(1e6 * (first + order / np.repeat(many, many) * (last - first)) + 0.5)
            packet["x"], packet["y"] = np.repeat(column, many), np.repeat(row, many)
            packet["p"] = np.repeat(np.sign(change[row, column]).astype(np.int8), many)
            packets.append(packet)
        return np.concatenate(packets)

    def _count(self, change: NDArray[np.float64]) -> NDArray[np.int64]:
        """Returns the events [H, W] of each pixel's change of log brightness, without sign."""
        if self._law.sensor_pixels > 1:
            return np.floor(change / self._law.tolerance + self._phases.random(change.shape)).astype(int)
        return np.where(change > self._law.threshold, np.floor(change / self._law.tolerance), 0).astype(int)


class FrameByFrame:
    """An emulator that is given frames in the order of time, from the beginning of the flight on."""

    def __init__(self, emulator: Any, see: See, mount: str) -> None:
        self._emulator, self._see, self._mount = emulator, see, mount
        self._next = 0.0

    def watch(self, track: Track, since: float, until: float) -> NDArray:
        """Returns the events of the frames before `until`; the levels that pixels remember are kept between windows."""
        packets = [np.empty(0, STREAM_DTYPE)]
        self._next = max(self._next, since - LEAD_S)
        while self._next < until - 1e-9:
            frame = see_at(self._see, track, self._next, self._mount)
            packets.append(self._emulator(frame, self._next))
            self._next += FRAME_S
        packet = np.concatenate(packets)
        return packet[packet["t"] >= 1e6 * since]


def esim() -> Any:
    """Returns evlib's ESIM: from a frame [H, W] and its time in seconds to events.

    Raises:
        MissingPackageError: if evlib, or PyTorch, on which its simulator stands, is not installed.
    """
    simulation = require_extra("evlib.simulation", extra="transfer")
    # Its tensors are small: several threads wait for each other, 40 times as long where the cores are busy.
    require_extra("torch", extra="transfer").set_num_threads(1)
    config = simulation.ESIMConfig(
        positive_threshold=CONTRAST,
        negative_threshold=CONTRAST,
        refractory_period_ms=0.0,
        log_floor=EPSILON,
        device="cpu",
    )
    simulator = require_extra("evlib.simulation.esim", extra="transfer").ESIMSimulator(config)

    def process(frame: NDArray[np.float64], time: float) -> NDArray:
        x, y, _, polarity = simulator.process_frame(255.0 * frame, time)
        return _packet(np.full(len(x), time), x, y, polarity)

    return process


def v2e() -> Any:
    """Returns v2e's emulator with its `noisy` figures: from a frame [H, W] and its time in seconds to events.

    Raises:
        MissingPackageError: if v2e is not installed.
    """
    try:
        emulator = require_extra("v2ecore.emulator", extra="transfer").EventEmulator(
            pos_thres=CONTRAST,
            neg_thres=CONTRAST,
            sigma_thres=0.05,
            cutoff_hz=30,
            leak_rate_hz=0.1,
            shot_noise_rate_hz=5.0,
            refractory_period_s=0.0,
            device="cpu",
        )
    except MissingPackageError:
        raise MissingPackageError(
            "v2e is not installed, and PyPI does not have it; install it from https://github.com/SensorsINI/v2e"
        ) from None

    def process(frame: NDArray[np.float64], time: float) -> NDArray:
        made = emulator.generate_events(255.0 * frame, time)
        if made is None:
            return np.empty(0, STREAM_DTYPE)
        return _packet(made[:, 0], made[:, 1], made[:, 2], made[:, 3])

    return process


def see_at(see: See, track: Track, time: float, mount: str) -> NDArray[np.float64]:
    """Returns what a camera on a track's body sees at a time, brightness [H, W]."""
    position, quaternion = track.at(time)
    return see(position, camera_rotation(quaternion, mount))


def _log(brightness: NDArray[np.float64], epsilon: float) -> NDArray[np.float64]:
    return np.log(brightness + epsilon)


def _packet(time: NDArray, x: NDArray, y: NDArray, polarity: NDArray) -> NDArray:
    packet = np.empty(len(x), STREAM_DTYPE)
    packet["t"], packet["x"], packet["y"] = np.round(1e6 * np.asarray(time)), x, y
    packet["p"] = np.where(np.asarray(polarity) > 0, 1, -1)
    return packet[np.argsort(packet["t"], kind="stable")]
