"""Pictures of recorded events show what they are given."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from edqn_jax.report.images import EVENTS, NEARNESS
from edqn_jax.report.recordings import Strip, animate_recording, pick_windows, plot_recording

RNG = np.random.default_rng(0)
STRIPS = [
    Strip("camera", RNG.integers(-2, 3, (4, 12, 16)), EVENTS),
    Strip("nearness", RNG.random((4, 3, 4)), NEARNESS),
]
TIMES_S = [0.0, 0.1, 0.2, 0.3]


@pytest.mark.parametrize(("windows", "most", "wanted"), [(3, 6, [0, 1, 2]), (11, 6, [0, 2, 4, 6, 8, 10]), (1, 6, [0])])
def test_moments_go_evenly_from_the_first_window_to_the_last(windows, most, wanted):
    assert pick_windows(windows, most).tolist() == wanted


def test_a_still_picture_has_a_row_a_strip_and_a_column_a_moment(tmp_path: Path):
    figure = plot_recording(STRIPS, TIMES_S, tmp_path / "a.png")
    assert len(figure.axes) == len(STRIPS) * len(TIMES_S)
    assert [axes.get_title() for axes in figure.axes[:4]] == [f"t = {time:.2f} s" for time in TIMES_S]
    assert figure.axes[1].get_xlabel() == f"{np.abs(STRIPS[0].pictures[1]).sum()} net events"
    drawn = [np.asarray(axes.images[0].get_array()) for axes in figure.axes]
    assert np.array_equal(np.stack(drawn[4:]), STRIPS[1].pictures)


def test_a_gif_has_a_frame_a_moment_and_greys_stay_grey():
    with Image.open(io.BytesIO(animate_recording(STRIPS, TIMES_S, 0.26))) as gif:
        assert getattr(gif, "n_frames", 1) == 4 and gif.info["duration"] == 260
        pixels = np.asarray(gif.convert("RGB")).astype(int)
    nearness = pixels[60:-40, pixels.shape[1] // 2 + 20 : -20]
    assert np.ptp(nearness, axis=-1).max() < 40  # of 255: median cut puts a few greys beside tints
