"""What a file's columns mean is found where only one reading is plausible, and refused elsewhere."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edqn_jax.errors import ConfigError
from edqn_jax.interop.recordings.recording import MICROSECONDS, Recording, infer_time_unit, recording_of
from tests.support.interop.recordings import some_events

EVENTS = some_events()
COLUMNS = {key: EVENTS[key] for key in "txyp"}


def made(**changed) -> Recording:
    columns: Any = {"time_unit": "us"} | COLUMNS | changed
    return recording_of("f", **columns)


@pytest.mark.parametrize("unit", MICROSECONDS)
def test_given_units_become_microseconds(unit):
    times = EVENTS["t"] * 1000 if unit == "ns" else EVENTS["t"] / MICROSECONDS[unit]
    assert np.array_equal(made(t=times, time_unit=unit).events, EVENTS)


@pytest.mark.parametrize(
    ("seconds", "events", "scale", "whole", "unit"),
    [
        (0.9, 2_000, 1.0, False, "s"),  # as milliseconds, less than one
        (600.0, 100_000, 1e9, True, "ns"),  # as microseconds, a week
        (20.0, 1_000_000, 1e6, True, "us"),  # as nanoseconds, 50 million a second; as milliseconds, 50
        (2.0, 4_000, 1e6, False, "us"),  # with decimals: as milliseconds, 2 a second
    ],
)
def test_the_only_plausible_unit_is_found(seconds, events, scale, whole, unit):
    t = np.linspace(0.0, seconds * scale, events)
    assert infer_time_unit("f", np.rint(t).astype(np.int64) if whole else t) == unit


@pytest.mark.parametrize("unit", MICROSECONDS)
def test_times_since_1970_say_their_unit(unit):
    since = 1_750_000_000 + np.linspace(0.0, 10.0, 1000)
    times = since if unit == "s" else np.rint(since * 1e6 / MICROSECONDS[unit]).astype(np.int64)
    assert infer_time_unit("f", times) == unit


def test_a_clock_that_runs_for_minutes_does_not_show_seconds_since_1970():
    """1.5e9 us after the camera began; and 1.5e12 ns, which as milliseconds would last 14 hours."""
    since = np.linspace(0.0, 20e6, 1_000_000)
    assert infer_time_unit("f", (1.5e9 + since).astype(np.int64)) == "us"
    with pytest.raises(ConfigError, match="us or ns"):
        infer_time_unit("f", (1.5e12 + np.linspace(0.0, 50e6, 10_000)).astype(np.int64))


@pytest.mark.parametrize(
    ("t", "units"),
    [
        (np.linspace(0, 60_000_000, 10_000).astype(np.int64), "us or ns"),  # a minute, or 60 ms
        (np.linspace(0, 10_000, 50_000).astype(np.int64), "ms or us"),  # 10 s, or 10 ms
        (np.linspace(0.0, 20.0, 5_000), "s or ms"),
        (np.zeros(10), "in none of them it is a plausible recording"),
    ],
)
def test_an_ambiguous_unit_is_refused_with_the_option_to_give(t, units):
    with pytest.raises(ConfigError, match=f"{units}; give --time-unit s, ms, us or ns"):
        infer_time_unit("f", t)


@given(st.sampled_from([(0, 1), (-1, 1), (False, True), (0.0, 1.0)]), st.integers(1, 50), st.randoms())
def test_either_way_of_writing_polarity_is_understood(kinds, number, random):
    chosen = [0, 1, *(random.randrange(2) for _ in range(number))]
    p = np.array([kinds[each] for each in chosen])
    found = made(**{key: np.ones(len(p), np.int64) for key in "txy"}, p=p).events["p"]
    assert found.tolist() == [2 * each - 1 for each in chosen]


@pytest.mark.parametrize("kinds", [(0, 255), (-1, 0, 1), (1, 2), (0.5, 1.0), (-1, 0)])
def test_other_polarities_are_refused(kinds):
    ones = np.ones(len(kinds), np.int64)
    with pytest.raises(ConfigError, match="must be 0 and 1, or -1 and 1, not"):
        made(t=ones, x=ones, y=ones, p=np.array(kinds))


def test_events_that_are_a_little_out_of_order_are_sorted_and_counted():
    t = EVENTS["t"].copy()
    t[[10, 11]] = t[[11, 10]] + np.array([1, 0])
    found = made(t=t)
    assert found.out_of_order == 1
    assert np.all(np.diff(found.events["t"]) >= 0)


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"t": np.roll(EVENTS["t"], 2000)}, "time goes back by .* at event 2,000"),
        ({"x": EVENTS["x"].astype(np.int64) - 1}, "pixels x from -1"),
        ({"x": EVENTS["x"], "size": (63, 48)}, "must be from 0 to 62"),
        ({"y": EVENTS["y"] + 0.5}, "no whole numbers"),
        ({"y": EVENTS["y"][1:]}, "columns of one length"),
        ({"t": np.full(4000, np.nan)}, "not all finite numbers"),
        ({"p": np.array(["on"] * 4000)}, "not all finite numbers"),
        ({key: EVENTS[key][:0] for key in "txyp"}, "holds no events"),
        ({"t": EVENTS["t"].astype(np.float64) * 1e30}, "beyond all clocks"),
    ],
)
def test_damaged_columns_are_refused_by_name(changed, says):
    with pytest.raises(ConfigError, match=says) as refused:
        made(**changed)
    assert "'f'" in str(refused.value)


def test_a_part_is_what_lies_between():
    part = made().between(0.5, 1.5)
    since = part.events["t"] - EVENTS["t"][0]
    assert since.min() >= 500_000 and since.max() < 1_500_000
    with pytest.raises(ConfigError, match="no events from 3 s on"):
        made().between(3.0, None)


def test_an_unknown_size_is_asked_for():
    with pytest.raises(ConfigError, match="give --size W H, at least 64 48"):
        made().size()
