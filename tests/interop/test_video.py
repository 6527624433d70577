"""An MP4 of a flight, read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from edqn_jax.extras import require_extra
from edqn_jax.report.animation import FPS, SIZE, _mp4


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_mp4_holds_every_frame_in_its_order(tmp_path: Path) -> None:
    shades = (20, 120, 220)
    file = tmp_path / "flight.mp4"
    file.write_bytes(_mp4([Image.new("RGB", SIZE, (shade,) * 3) for shade in shades], FPS))
    about, *frames = require_extra("imageio_ffmpeg", "video").read_frames(str(file))
    assert (about["size"], about["codec"], about["fps"]) == (SIZE, "h264", FPS)
    # Twice rounded, to the levels of video and back.
    assert [np.frombuffer(frame, np.uint8).mean() for frame in frames] == pytest.approx(shades, abs=3)
