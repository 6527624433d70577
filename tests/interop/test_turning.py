"""What pixels that turn add to their events, beside a plain sensor of which the change is known."""

from __future__ import annotations

import numpy as np

from edqn_jax.interop.deployment import runner

ABOUT = {"width": 2, "height": 2, "horizontal_fov_deg": 90.0}
GRID = runner.Grid.of(ABOUT, (40, 40))
EVENT = np.dtype([("t", np.int64), ("x", np.int16), ("y", np.int16), ("p", np.int8)])
CONTRAST = 0.2


def event(t: int, x: int, y: int, p: int) -> np.ndarray:
    return np.array([(t, x, y, p)], EVENT)


def test_a_first_event_is_one_and_a_half_one_that_goes_on_is_one_and_one_that_turns_is_two() -> None:
    turning = runner.Turning(GRID)
    added = [turning.take(event(t, 3, 5, p)).sum(axis=(1, 2)) for t, p in enumerate((1, 1, -1, -1, 1))]
    np.testing.assert_array_equal(added, [[0.5, 0], [0, 0], [0, 1], [0, 0], [1, 0]])


def test_they_count_in_the_pixel_of_the_policy_and_in_the_order_of_time() -> None:
    packet = np.concatenate([event(7, 39, 1, -1), event(3, 39, 1, 1), event(5, 2, 30, 1)])
    added = runner.Turning(GRID).take(packet)
    np.testing.assert_array_equal(added, [[[0, 0], [0.5, 0]], [[0, 0.5], [0, 0]]])


def test_pixels_outside_of_the_view_add_nothing() -> None:
    narrow = runner.Grid.of(ABOUT, (40, 40), 120.0)
    assert narrow.cells[0, 0] == -1
    assert not runner.Turning(narrow).take(event(0, 0, 0, 1)).any()


def test_with_them_events_say_on_average_how_much_brightness_changed() -> None:
    # Each pixel's log brightness is a sum of waves; its sensor fires as Eq. 1 of ESIM has it, from its first value on.
    rng = np.random.default_rng(0)
    times = np.linspace(0.0, 2.0, 400)
    waves = rng.uniform(0.1, 0.5, (4, 1600, 1)), rng.uniform(2.0, 12.0, (4, 1600, 1)), rng.uniform(0, 7, (4, 1600, 1))
    log = sum(size * np.sin(rate * times + phase) for size, rate, phase in zip(*waves, strict=True))
    level, packets = log[:, 0].copy(), []
    for number in range(1, len(times)):
        while (apart := log[:, number] - level)[np.abs(apart) >= CONTRAST].size:
            pixel = np.flatnonzero(np.abs(apart) >= CONTRAST)
            sign = np.sign(apart[pixel])
            level[pixel] += CONTRAST * sign
            packets += [event(number, each % 40, each // 40, int(p)) for each, p in zip(pixel, sign, strict=True)]
    events = np.concatenate(packets)
    turning, alone, together, true = runner.Turning(GRID), [], [], []
    for begin in range(1, 400, 30):
        packet = events[(events["t"] >= begin) & (events["t"] < begin + 30)]
        net = np.zeros((2, 2))
        np.add.at(net, (packet["y"] // 20, packet["x"] // 20), packet["p"])
        added = turning.take(packet)
        alone.append(CONTRAST * net / 400)
        together.append(CONTRAST * (net + added[0] - added[1]) / 400)
        end = min(begin + 29, 399)
        change = (log[:, end] - log[:, begin - 1]).reshape(2, 20, 2, 20).mean((1, 3))
        true.append(change)
    alone, together, true = (np.array(each).ravel() for each in (alone, together, true))
    slope_alone, slope = (each @ true / (true @ true) for each in (alone, together))
    assert slope_alone < 0.9
    assert abs(slope - 1) < 0.06  # changes that end at a crest have gone on by less
