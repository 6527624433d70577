"""`edqn events`, `edqn record FILE.h5` and `edqn export`: what they write, what they refuse."""

from __future__ import annotations

import functools
import json
import struct
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from PIL import Image

import edqn_jax
from edqn_jax.cli import main
from edqn_jax.config import Config
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.interop.deployment import runner
from edqn_jax.interop.recordings.event_files import read_events, write_events
from edqn_jax.interop.recordings.recording import Recording
from edqn_jax.interop.recordings.seen_events import observe_recording, window_ends
from edqn_jax.learn.perception import vae
from edqn_jax.learn.policy import Policy
from edqn_jax.sim.environment import Environment
from edqn_jax.sim.task.observation import Observation
from tests.support.interop.recordings import some_recording

pytestmark = pytest.mark.filterwarnings("ignore")  # jax2onnx and what it imports


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The sentence of a command that ends with exit code 2."""
    assert main([str(word) for word in words]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.startswith("edqn: ")
    return said


@functools.partial(jax.jit, static_argnums=0)
def _decoded(config: Config, params: Any, seen: Observation) -> jax.Array:
    code = vae.embed(config.encoder, params, seen.sensed, seen.motion)  # type: ignore[arg-type]
    return vae.decode(config.encoder, config.camera, params, code)[-1]


def decoded(policy: Policy, seen: Observation) -> jax.Array:
    return _decoded(policy.config, policy.params.encoder, seen)


def done(*words: object) -> None:
    assert main([str(word) for word in words]) == 0


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    """The events of a flight through a sparse world, at twice the policy's resolution along each axis."""
    file = tmp_path_factory.mktemp("flight") / "flight.h5"
    done("record", "pretrained", file, "--world", "sparse", "--size", "64", "48")
    return file


def test_it_says_what_a_file_holds(tmp_path, capsys):
    write_events(tmp_path / "a.npz", some_recording())
    done("events", tmp_path / "a.npz", "--json", tmp_path / "found.json")
    found = json.loads((tmp_path / "found.json").read_text())
    assert (found["events"], found["width"], found["height"]) == (4000, 64, 48)
    assert found["events_per_second"] == pytest.approx(2000, rel=0.01)  # 4,000 in 2 s
    assert (found["time_unit"], found["polarity"]) == ("us, as the file says", "-1 and 1")
    said = capsys.readouterr().out
    assert "4,000" in said and "64 × 48 pixels" in said


def test_it_says_what_was_assumed_sorted_and_left_out(tmp_path, capsys):
    rows = "".join(f"{t / 1e6:.6f} {x} {y} {int(p > 0)}\n" for t, x, y, p in some_recording().events.tolist())
    (tmp_path / "a.txt").write_text(rows)
    done("events", tmp_path / "a.txt", "--time-unit", "s")
    assert "t x y p, as no line names them" in capsys.readouterr().out
    early = struct.pack("<5I", 1 << 28, 8 << 28 | 99, 1 << 28, 8 << 28 | 40000, 1 << 28)
    (tmp_path / "a.raw").write_bytes(b"% evt 2.0\n% geometry 64x48\n% end\n" + early)
    done("events", tmp_path / "a.raw", "--json", tmp_path / "found.json")
    found = json.loads((tmp_path / "found.json").read_text())
    assert (found["events"], found["left_out"], found["columns"]) == (2, 1, None)
    said = capsys.readouterr().out
    assert "left out" in said and "2.554 s without an event" in said


def test_a_part_is_written_in_another_form(tmp_path):
    recording = some_recording()
    write_events(tmp_path / "a.npz", recording)
    done("events", tmp_path / "a.npz", "--start", "0.5", "--stop", "1", "--out", tmp_path / "b.txt")
    assert np.array_equal(read_events(tmp_path / "b.txt").events, recording.between(0.5, 1.0).events)


@pytest.mark.parametrize(("policy", "panels"), [(False, 1), (True, 3)])
def test_pictures_show_windows(tmp_path, flight, policy, panels):
    words = ["--policy", "pretrained"] if policy else []
    done("events", flight, "--stop", "2", *words, "--picture", tmp_path / "a.png")
    done("events", flight, "--stop", "2", *words, "--picture", tmp_path / "a.gif")
    with Image.open(tmp_path / "a.png") as still, Image.open(tmp_path / "a.gif") as moving:
        assert still.size[0] > still.size[1] / panels
        # In 2 s there are windows of 0.05 s, or decisions of 0.26 s whose windows are wholly in it.
        assert getattr(moving, "n_frames", 1) == pytest.approx(7 if policy else 40, abs=1)
        assert moving.size == (320 * panels + 20, 300)


def test_a_policy_sees_in_a_recorded_flight_what_it_saw_when_it_flew(flight):
    """Its own frames make the same changes of brightness as those of the finer camera, averaged."""
    policy = edqn_jax.load_policy("pretrained")
    recording = read_events(flight)
    seen = observe_recording(policy, recording)
    missions = load_missions(policy.config, "sparse", 1, 0, None, None)
    environment = Environment(policy.config, missions.env_params)
    state, observation = environment.reset(0, 0)
    memory, images, nears = None, [], []
    for _ in seen.until_us:
        move, memory = policy.act(observation, memory)
        state, step = environment.step(state, move)
        observation = step.observation
        images.append(environment.event_image(observation))
        nears.append(np.asarray(decoded(policy, observation)))
    wanted, drawn = np.stack(images), np.stack(nears)
    # Rounding down to whole events, the log of a mean and the mean of logs differ by an event here and there.
    assert np.corrcoef(wanted.ravel(), seen.image.ravel())[0, 1] > 0.9
    assert np.sqrt(np.mean((drawn - seen.decoded) ** 2)) < 0.2 * drawn.std()


def test_windows_lie_within_the_recording():
    recording = some_recording()
    ends = window_ends(recording, 80_000, 260_000)
    assert ends[0] - 80_000 == recording.events["t"][0] and ends[-1] <= recording.events["t"][-1] + 1
    assert set(np.diff(ends)) == {260_000}


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--start", "9"], "there are no events from 9 s on"),
        (["--policy", "pretrained", "--window", "0.1"], "--window and --policy cannot both be given"),
        (["--policy", "pretrained", "--fov", "190"], "camera_fov_deg must be between 0 and 180"),
        (["--policy", "nowhere"], "there is no run in 'nowhere'"),
        (["--picture", "a.jpg"], "must end in .png or .gif"),
        (["--out", "a.raw"], "must end in .h5"),
        (["--stream", "1"], "--stream is for .aedat4"),
        (["--contrast", "0"], "--contrast must be above 0"),
        (["--contrst", "1"], "did you mean '--contrast'?"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, capsys, monkeypatch, words, says):
    monkeypatch.chdir(tmp_path)
    write_events(tmp_path / "a.npz", some_recording())
    assert says in refused(capsys, "events", "a.npz", *words)
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]


def test_a_camera_with_fewer_pixels_than_the_policy_is_refused(tmp_path, capsys):
    few = some_recording().events[:100]
    few["x"], few["y"] = few["x"] // 4, few["y"] // 4
    write_events(tmp_path / "a.npz", Recording(few, 16, 12))
    said = refused(capsys, "events", tmp_path / "a.npz", "--policy", "pretrained")
    assert "16 x 12 pixels has fewer" in said


def test_a_damaged_file_and_a_missing_one_are_named(tmp_path, capsys):
    (tmp_path / "a.h5").write_bytes(b"nothing")
    assert f"'{tmp_path / 'a.h5'}' is damaged" in refused(capsys, "events", tmp_path / "a.h5")
    assert f"there is no file '{tmp_path / 'b.h5'}'" in refused(capsys, "events", tmp_path / "b.h5")


def test_a_size_is_only_for_events(tmp_path, capsys):
    assert "at least 200, not 8 6" in refused(capsys, "record", "pretrained", "a.gif", "--size", 8, 6)
    assert "must be even" in refused(capsys, "record", "pretrained", "a.mp4", "--size", 801, 540)
    assert "--speed is only for videos" in refused(capsys, "record", "pretrained", "a.npz", "--speed", 2)
    assert "--fps must be from 0.01 to 50" in refused(capsys, "record", "pretrained", "a.gif", "--fps", 60)
    assert "at least 1, not 0 5" in refused(capsys, "record", "pretrained", "a.h5", "--size", 0, 5)
    assert "is a folder" in refused(capsys, "events", tmp_path)
    assert "must end in .gif or .mp4 for a video" in refused(capsys, "record", "pretrained", tmp_path / "a.avi")


def test_export_writes_a_policy_and_its_runner(tmp_path, capsys):
    done("export", "pretrained", "--out", tmp_path / "policy.onnx")
    assert "chooses JAX's moves" in capsys.readouterr().out
    assert {file.name for file in tmp_path.iterdir()} == {"policy.onnx", "edqn_runner.py"}
    assert runner.Runner(tmp_path / "policy.onnx").about["policy_sha256"]


def test_export_refuses_what_it_cannot_do(tmp_path, capsys):
    assert "--out 'policy.pt' must end in .onnx" in refused(capsys, "export", "pretrained", "--out", "policy.pt")
    assert "at least 1000" in refused(capsys, "export", "pretrained", "--out", "a.onnx", "--checks", 10)
    assert "there is no run in 'nowhere'" in refused(capsys, "export", "nowhere", "--out", "a.onnx")
