"""A flight as an animated GIF, and `edqn record` from a run to its file."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from edqn_jax.cli import main, record
from edqn_jax.config import WorldConfig
from edqn_jax.config.loading import to_yaml
from edqn_jax.errors import ConfigError
from edqn_jax.interop import flight_files
from edqn_jax.learn.policy import PolicyParams, fresh_policy
from edqn_jax.report.animation import LAST_FRAME_S, MAX_FRAMES, SIZE, Film, _rows_shown, encode_gif
from edqn_jax.report.sights import SensorImages
from edqn_jax.report.style import OUTCOME_COLOURS
from edqn_jax.runs.checkpoints.params import save_params
from edqn_jax.sim.scene.mjcf import write_scene
from tests.support.box_flight import SMALL, Drawn, a_flight, recorded, world_with_a_box
from tests.support.policies import always

pytestmark = pytest.mark.whole


def frames(image: Image.Image) -> int:
    return getattr(image, "n_frames", 1)


def pixels_like(image: Image.Image, frame: int, colour: str) -> int:
    image.seek(frame)
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return int((np.abs(np.asarray(image.convert("RGB")).astype(int) - wanted).max(axis=-1) < 25).sum())


@pytest.mark.slow
def test_there_is_a_frame_for_each_decision_and_one_for_the_end():
    gif = recorded(Drawn(), 6.4)
    assert (gif.format, gif.size, frames(gif)) == ("GIF", SIZE, 7)
    gif.seek(6)
    assert gif.info["duration"] == 1000 * LAST_FRAME_S


@pytest.mark.slow
def test_a_long_flight_leaves_decisions_out():
    assert frames(recorded(Drawn(), MAX_FRAMES + 10)) == (MAX_FRAMES + 10) // 2 + 1


@pytest.mark.slow
def test_speed_and_frames_a_second_say_what_frames_show_and_a_size_is_that_of_the_picture():
    film = Film(speed=2.0, fps=5, size=(640, 360))
    gif = recorded(Drawn(), 6.4, film=film)  # 83 steps of 0.02 s: 1.66 s, of which a frame shows 0.4 s
    assert (gif.size, frames(gif), gif.info["duration"]) == ((640, 360), 5, 200)
    drone = SMALL.drone
    rows, speed = _rows_shown(drone, a_flight(6.4), 2.0, 0.2)
    assert rows.tolist() == [19, 39, 59, 79] and speed == 2.0
    rows, speed = _rows_shown(drone, a_flight(6.4), None, 0.1)
    assert rows.tolist() == [12, 25, 38, 51, 64, 77] and speed == pytest.approx(2.6)
    rows, _ = _rows_shown(drone, a_flight(6.4), 1.0, 1 / 120)  # a frame is less than half of a step
    assert rows[0] == 0 and rows[-1] <= 82 and np.all(np.diff(rows) >= 0)


def test_a_video_that_would_not_fit_into_memory_is_refused():
    with pytest.raises(ConfigError, match="too many of its size"):
        recorded(Drawn(), 60, film=Film(speed=0.1, fps=50))


@pytest.mark.slow
def test_the_last_frame_says_how_the_flight_ended_in_its_colour():
    gif = recorded(Drawn(), 4, outcome="collision")
    colour = OUTCOME_COLOURS["collision"]
    assert pixels_like(gif, 4, colour) > pixels_like(gif, 3, colour) + 100


def test_few_green_pixels_stay_green_beside_many_vivid_ones():
    """As in a mesh, whose distances alone have more colours than a palette."""
    pixels = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
    pixels[..., 1] = np.minimum(pixels[..., 1], pixels[..., 0])  # no green among them
    green = [int(OUTCOME_COLOURS["goal"][i : i + 2], 16) for i in (1, 3, 5)]
    pixels[100:104, 100:104] = green
    with Image.open(io.BytesIO(encode_gif([Image.fromarray(pixels)], [0.1]))) as gif:
        shown = np.asarray(gif.convert("RGB")).astype(int)[100:104, 100:104]
    assert np.abs(shown - green).max() < 8


@pytest.mark.slow
def test_a_sensor_without_an_image_is_said_to_have_none():
    class Blind(Drawn):
        has_image = False

    assert frames(recorded(Blind(), 3)) == 4


def always_ahead() -> PolicyParams:
    """A policy for the camera of `SMALL` that flies ahead whatever it sees."""
    return dataclasses.replace(fresh_policy(SMALL), q=always((1, 0, 0)).q)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    (folder / "config.yaml").write_text(to_yaml(SMALL))
    save_params(folder / "checkpoints", always_ahead())
    return folder


@pytest.mark.slow
def test_a_saved_run_is_recorded_on_another_world(run, tmp_path, capsys):
    world, file = tmp_path / "box.xml", tmp_path / "flight.gif"
    scene = world_with_a_box()
    write_scene(dataclasses.replace(scene, volume=scene.volume * np.array([1, 1, 9.0], np.float32)), world)
    assert main(["record", str(run), str(file), "--world", str(world)]) == 0
    said = capsys.readouterr().out
    assert "collision after 2.7 s" in said and "is much larger than those that the policy was trained in" in said
    with Image.open(file) as gif:
        assert (gif.size, frames(gif)) == (SIZE, 11)
    assert file.stat().st_size < 3e6


@pytest.mark.parametrize(
    ("flown", "asked", "world"), [("paper", [], "paper"), ("", [], "sparse"), ("paper", ["--world", "dense"], "dense")]
)
def test_a_run_is_recorded_where_its_last_flight_was(flown, asked, world, tmp_path, monkeypatch, capsys):
    trained = dataclasses.replace(SMALL, world=WorldConfig(name="sparse", flown=flown))
    (tmp_path / "config.yaml").write_text(to_yaml(trained))
    save_params(tmp_path / "checkpoints", always_ahead())

    def named(config, name, *_):
        raise ConfigError(f"asked for {name}")

    monkeypatch.setattr(flight_files, "load_missions", named)
    assert main(["record", str(tmp_path), str(tmp_path / "flight.gif"), *asked]) == 2
    assert f"asked for {world}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("file", "says"),
    [
        ("flight.avi", "must end in .gif or .mp4"),
        ("missing/flight.gif", "cannot be written: there is no folder"),
    ],
)
def test_a_file_that_cannot_be_written_is_refused_at_once(file, says, run, tmp_path, capsys):
    assert main(["record", str(run), str(tmp_path / file)]) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_mp4_without_its_package_is_refused_at_once(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(record.importlib.util, "find_spec", lambda name: None)
    assert main(["record", str(run), str(tmp_path / "flight.mp4")]) == 2
    assert "run pip install 'edqn-jax[video]'" in capsys.readouterr().err


def test_a_folder_without_a_run_is_refused(tmp_path, capsys):
    assert main(["record", str(tmp_path), str(tmp_path / "flight.gif")]) == 2
    assert "there is no run in" in capsys.readouterr().err


class Predicting(Drawn):
    """Sights of a policy whose decoder predicts distance, this many times the true one."""

    def __init__(self, factor: float) -> None:
        self.factor = factor

    def shown(self, params: object, flown: dict[str, np.ndarray]) -> SensorImages:
        true = np.full((len(flown["t"]) // 13, 24, 32), 4.0)
        images = super().shown(params, flown)
        return dataclasses.replace(images, distance=true, predicted=true * self.factor)


def test_predicted_distance_stands_beside_the_true_one():
    good, bad = (np.asarray(recorded(Predicting(factor), 1).convert("RGB"), int) for factor in (1.0, 3.0))
    rows, columns = np.nonzero(np.abs(good - bad).max(axis=2) > 100)
    # The picture of the prediction alone and its caption, left of the true one.
    assert len(rows) > 10_000 and rows.min() > 360 and columns.min() > 200 and columns.max() < 405
    plain = np.asarray(recorded(Drawn(), 1).convert("RGB"), int)
    assert np.abs(plain - good)[360:, 210:].max() > 100


def test_what_the_policy_was_not_trained_for_is_said_before_the_flight(run, tmp_path, monkeypatch, capsys):
    world, scene = tmp_path / "box.xml", world_with_a_box()
    write_scene(dataclasses.replace(scene, volume=scene.volume * np.array([1, 1, 9.0], np.float32)), world)

    def fly(*_, **__):
        raise ConfigError("not flown")

    monkeypatch.setattr(flight_files, "_fly_missions", fly)
    with pytest.raises(ConfigError, match="not flown"):
        record.record_command(record.RecordArgs(run, tmp_path / "flight.gif", world=str(world)))
    assert "is much larger than those that the policy was trained in" in capsys.readouterr().out
