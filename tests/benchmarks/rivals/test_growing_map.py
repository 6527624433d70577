"""Pictures of the map that grows show what is known at the drone's height, and where it flew."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from matplotlib.colors import ListedColormap
from PIL import Image

from rivals.mapping.growing_map import FREE, OCCUPIED, UNKNOWN, Moment, animate_growth, draw_growth, known_at
from tests.support.drawn_scenes import one_of_each_kind

SHAPE = (22, 22, 5)
CELL_M = 5.0


def a_moment(time_s: float) -> Moment:
    log_odds = np.zeros(SHAPE)
    log_odds[: 2 + int(time_s), :, 2] = -1.0
    log_odds[6, 6] = 2.0
    flown = np.array([[1.0, 1.0, 11.0], [5.0, 5.0, 11.0]])
    return Moment(time_s, log_odds, flown, np.array([[5.0, 5.0, 11.0], [20.0, 30.0, 11.0]]), np.full((6, 8), 4.0))


def test_a_cell_is_occupied_before_it_is_free_and_unknown_otherwise() -> None:
    log_odds = np.zeros((4, 1, 9))
    log_odds[1, 0, 4], log_odds[2, 0, 4], log_odds[2, 0, 5] = -1.0, -1.0, 1.0
    log_odds[3, 0, 7] = 1.0  # far above
    assert known_at(log_odds, 4)[:, 0].tolist() == [UNKNOWN, FREE, OCCUPIED, UNKNOWN]
    assert known_at(log_odds, 0)[:, 0].tolist() == [UNKNOWN] * 4


def test_each_moment_is_a_column_with_its_map_and_its_distances(tmp_path: Path) -> None:
    moments = [a_moment(time) for time in (0.0, 2.6, 5.2)]
    figure = draw_growth(one_of_each_kind(), CELL_M, moments, tmp_path / "map.png")
    with Image.open(tmp_path / "map.png") as picture:
        assert picture.size[0] > 1000
    maps, pictures = figure.axes[:3], figure.axes[3:6]
    assert [axes.get_title() for axes in maps] == ["t = 0.0 s", "t = 2.6 s", "t = 5.2 s"]
    for axes, picture, moment in zip(maps, pictures, moments, strict=True):
        shown = np.asarray(axes.images[0].get_array())
        np.testing.assert_array_equal(shown, known_at(moment.log_odds, 2).T)  # 11 m up, in cells of 5 m
        assert isinstance(axes.images[0].cmap, ListedColormap)
        assert list(axes.images[0].get_extent()) == [0.0, 110.0, 0.0, 110.0]
        plan, flown = axes.lines[:2]
        np.testing.assert_array_equal(np.array(plan.get_data()).T, moment.plan[:, :2])
        np.testing.assert_array_equal(np.array(flown.get_data()).T, moment.flown[:, :2])
        np.testing.assert_allclose(np.asarray(picture.images[0].get_array()), 0.5)  # 1 / (1 + 4 m / 4 m)


def test_the_gif_has_a_frame_for_each_moment_and_rests_on_the_last() -> None:
    gif = Image.open(
        io.BytesIO(animate_growth(one_of_each_kind(), CELL_M, [a_moment(time) for time in (0.0, 3.0)], "a map"))
    )
    assert gif.n_frames == 2  # type: ignore[attr-defined]
    seconds = []
    for frame in range(2):
        gif.seek(frame)
        seconds.append(gif.info["duration"] / 1000)
    assert seconds[0] < 0.3 < 2.0 < seconds[1]
