"""Small synthetic recordings."""

from __future__ import annotations

import numpy as np

from edqn_jax.interop.recordings.recording import Recording
from edqn_jax.sim.sensors.event_field import STREAM_DTYPE

WIDTH, HEIGHT = 64, 48


def some_events(number: int = 4000, seconds: float = 2.0, begin_us: int = 1_000_000, seed: int = 0) -> np.ndarray:
    """Events at random pixels, evenly spread over time, of both polarities."""
    rng = np.random.default_rng(seed)
    events = np.empty(number, STREAM_DTYPE)
    events["t"] = begin_us + np.sort(rng.integers(0, round(seconds * 1e6), number))
    events["x"], events["y"] = rng.integers(0, WIDTH, number), rng.integers(0, HEIGHT, number)
    events["p"] = rng.choice([-1, 1], number)
    return events


def some_recording(**others: object) -> Recording:
    return Recording(some_events(), WIDTH, HEIGHT, **others)  # type: ignore[arg-type]
