"""Pictures beside events, as a DAVIS takes them, in files that iniVation's own library writes."""

from __future__ import annotations

import datetime
import json
from pathlib import Path

import numpy as np
import pytest

from edqn_jax.cli.events import events_command, parse_events
from edqn_jax.extras import require_extra
from edqn_jax.interop.recordings.event_files import read_events

dv = require_extra("dv_processing", extra="fly")

SIZE = WIDTH, HEIGHT = 346, 260

EXPOSURE_US = 5_000


def written(file: Path, images: list[np.ndarray], began_us: list[int]) -> Path:
    """Returns a file of 3,000 events over 0.3 s, and of pictures whose exposures began at these times."""
    writer = dv.io.MonoCameraWriter(str(file), dv.io.MonoCameraWriter.DAVISConfig("DAVIS346_7", SIZE))
    rng, events = np.random.default_rng(0), dv.EventStore()
    for number in range(3000):
        events.push_back(1_000_000 + 100 * number, int(rng.integers(WIDTH)), int(rng.integers(HEIGHT)), number % 2 == 0)
    writer.writeEvents(events)
    for image, began in zip(images, began_us, strict=True):
        frame = dv.Frame(began, image)
        frame.exposure = datetime.timedelta(microseconds=EXPOSURE_US)
        writer.writeFrame(frame)
    return file


def test_pictures_are_read_with_the_ends_of_their_exposures(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    images = [rng.integers(0, 256, (HEIGHT, WIDTH), np.uint8) for _ in range(3)]
    began = [1_000_000, 1_040_000, 1_080_000]
    recording = read_events(written(tmp_path / "a.aedat4", images, began))
    pictures = recording.pictures
    assert len(recording.events) == 3000 and recording.size() == SIZE and pictures is not None
    assert pictures.until_us.tolist() == [each + EXPOSURE_US for each in began]
    np.testing.assert_array_equal(np.stack([pictures.image(number) for number in range(3)]), np.stack(images))
    newest = {1_000_000: 0, 1_044_999: 0, 1_045_000: 1, 2_000_000: 2}  # none before: the first is shown
    for moment, number in newest.items():
        np.testing.assert_array_equal(pictures.newest(moment), images[number])
    assert recording.between(0.1, 0.2).pictures is pictures


def test_colours_become_grey_by_the_papers_weights(tmp_path: Path) -> None:
    blue_green_red = np.random.default_rng(2).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    pictures = read_events(written(tmp_path / "a.aedat4", [blue_green_red], [1_000_000])).pictures
    assert pictures is not None
    blue, green, red = np.moveaxis(blue_green_red.astype(float), -1, 0)
    np.testing.assert_allclose(pictures.image(0), 0.299 * red + 0.587 * green + 0.114 * blue, atol=0.501)


def test_pictures_of_other_numbers_than_bytes_are_left_out_and_events_are_not(tmp_path: Path) -> None:
    deep = np.zeros((HEIGHT, WIDTH), np.uint16)
    recording = read_events(written(tmp_path / "a.aedat4", [deep], [1_000_000]))
    assert len(recording.events) == 3000 and recording.pictures is None


def test_they_stand_beside_what_a_policy_makes_of_the_events(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = written(
        tmp_path / "a.aedat4",
        [np.full((HEIGHT, WIDTH), 40 * k, np.uint8) for k in range(6)],
        [1_000_000 + 50_000 * k for k in range(6)],
    )
    drawn = []
    monkeypatch.setattr("edqn_jax.report.recordings.plot_recording", lambda strips, *_: drawn.extend(strips))
    words = [
        str(file),
        "--policy",
        "pretrained",
        "--picture",
        str(tmp_path / "a.png"),
        "--json",
        str(tmp_path / "a.json"),
    ]
    events_command(parse_events(words))
    assert json.loads((tmp_path / "a.json").read_text())["pictures"] == 6
    assert [strip.title.split(",")[0] for strip in drawn] == [
        "camera",
        "policy sees",
        "decoded nearness",
        "camera's picture",
    ]
    # Its window ends 0.08 s after the first event, when the exposure of the second picture has ended.
    assert [int(picture.max()) for picture in drawn[-1].pictures] == [40]
