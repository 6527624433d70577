"""Events that are counted as they come are those that a decision would have counted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from edqn_jax.fly.streams import EVENT, Events
from edqn_jax.fly.tally import Tally, events_at_pace
from edqn_jax.interop.deployment import runner

SIZE = (64, 48)
ABOUT = {
    "width": 8,
    "height": 6,
    "horizontal_fov_deg": 90.0,
    "frame_times_us": [-160_000, -80_000, 0],
    "contrast_on": 0.1,
    "contrast_off": 0.1,
    "least_count": 1,
    "counts_net": True,
}


class Counting(runner.Runner):
    """A runner without a network."""

    def __init__(self) -> None:
        self.about = ABOUT
        self._grid = runner.Grid.of(ABOUT, SIZE, 100.0)


def packet(rng: np.random.Generator, begin: int, end: int) -> np.ndarray:
    events = np.zeros(int(rng.integers(0, 300)), EVENT)
    events["t"] = np.sort(rng.integers(begin, end, events.size))
    events["x"], events["y"] = rng.integers(0, SIZE[0], events.size), rng.integers(0, SIZE[1], events.size)
    events["p"] = rng.choice([-1, 1], events.size)
    return events


@pytest.mark.parametrize("pace", [1.0, 0.7, 0.35, 0.2])
def test_they_are_those_of_the_window(pace: float) -> None:
    rng, counting, events = np.random.default_rng(round(100 * pace)), Counting(), Events(SIZE)
    tally, end, checked = Tally(counting, pace), 3_000_000, 0
    for number in range(600):
        begin, end = end, end + int(rng.integers(500, 9_000))
        if number == 300:  # the camera's clock begins anew
            begin, end = 0, 5_000
        made = packet(rng, begin, end)
        events.add(made, end, 1e-6 * end)
        tally.take([(end, made)])
        if number % 7 == 0:
            window = events.window(end - round(counting.window_us / pace), end)
            wanted = runner._numbers_of(
                ABOUT, events_at_pace(window, end, pace), end - counting.window_us, counting._grid
            )
            found: Any = tally.number(end)
            assert np.array_equal(found, wanted)
            checked += int(wanted.sum() > 0)
    assert checked > 70


def test_what_cannot_be_counted_is_left_to_the_decision() -> None:
    tally, events = Tally(Counting(), 1.0), np.zeros(3, EVENT)
    assert tally.number(1_000) is None
    events["t"], events["x"], events["y"], events["p"] = 500, 32, 24, 1
    tally.take([(1_000, events)])
    known: Any = tally.number(1_000)
    assert known.sum() == 3
    outside = events.copy()
    outside["x"], outside["t"] = SIZE[0], 1_500
    tally.take([(2_000, outside)])
    assert tally.number(2_000) is None
