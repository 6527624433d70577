"""Files of poses: read back, onto the events' clock, and a policy that reads a flight's events with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import edqn_jax
from edqn_jax.cli import main
from edqn_jax.errors import ConfigError
from edqn_jax.interop.recordings.event_files import read_events, write_events
from edqn_jax.interop.recordings.poses import with_poses
from edqn_jax.interop.recordings.recording import Recording
from edqn_jax.interop.recordings.seen_events import observe_recording
from tests.support.interop.recordings import some_recording

EUROC = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x []"


def circle(time_s: np.ndarray) -> np.ndarray:
    """Rows of t x y z qx qy qz qw of a body that flies a circle of 2 m at 1 rad/s, looking ahead."""
    yaw = time_s + np.pi / 2
    columns = 2 * np.cos(time_s), 2 * np.sin(time_s), np.full_like(time_s, 1.5), 0 * yaw, 0 * yaw
    return np.stack([time_s, *columns, np.sin(yaw / 2), np.cos(yaw / 2)], axis=1)


def written(file: Path, rows: np.ndarray, head: str = "", apart: str = " ") -> Path:
    file.write_text(head + "".join(apart.join(f"{each:.9f}" for each in row) + "\n" for row in rows))
    return file


def test_a_flight_has_the_velocity_and_the_heading_of_its_poses(tmp_path: Path) -> None:
    rows = circle(np.arange(0.5, 3.5, 0.01))
    placed = with_poses(some_recording(), written(tmp_path / "a.txt", rows), "body", 4.0)  # events from 1 s to 3 s
    flight = placed.flight
    assert flight is not None and flight["t"][0] >= 1_000_000 and flight["t"][-1] <= 3_000_000
    time = 1e-6 * flight["t"][5:-5]
    np.testing.assert_allclose(flight["velocity"][5:-5, 0], -2 * np.sin(time), atol=1e-3)
    np.testing.assert_allclose(flight["position"][5:-5, 1], 2 * np.sin(time), atol=1e-3)
    assert (flight["move"] == [0, 0, 0]).all()  # 2 m/s are half of what a move commands, and rint(0.5) is 0
    fast = with_poses(some_recording(), tmp_path / "a.txt", "body", 2.0).flight
    assert fast is not None and (fast["move"][5:-5] == [1, 0, 0]).all()


def test_names_decide_the_columns_and_time_the_unit(tmp_path: Path) -> None:
    rows = circle(np.arange(0.5, 3.5, 0.01))
    plain = with_poses(some_recording(), written(tmp_path / "a.txt", rows), "body", 4.0).flight
    euroc = np.concatenate([1e9 * rows[:, :1], rows[:, 1:4], rows[:, 7:8], rows[:, 4:7], rows[:, :1]], axis=1)
    named = with_poses(some_recording(), written(tmp_path / "a.csv", euroc, EUROC + "\n", ","), "body", 4.0).flight
    assert plain is not None and named is not None
    for key, column in plain.items():
        np.testing.assert_allclose(named[key], column, atol=1e-6)


def test_a_camera_that_looks_ahead_is_a_body_that_does(tmp_path: Path) -> None:
    rows = circle(np.arange(0.5, 3.5, 0.01))
    turned = rows.copy()
    for row, (_, _, _, _, x, y, z, w) in zip(turned, rows, strict=True):
        # Times the turn from the camera's axes to the body's: z ahead, x to the right, y down.
        a, b, c, d = 0.5, -0.5, 0.5, -0.5
        row[4:] = (
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
            w * a - x * b - y * c - z * d,
        )
    body = with_poses(some_recording(), written(tmp_path / "b.txt", rows), "body", 2.0).flight
    camera = with_poses(some_recording(), written(tmp_path / "c.txt", turned), "camera", 2.0).flight
    assert body is not None and camera is not None
    same = np.abs(np.sum(body["quaternion"] * camera["quaternion"], axis=1))
    np.testing.assert_allclose(same, 1.0, atol=1e-9)
    assert (camera["move"] == body["move"]).all()


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        (circle(np.arange(90.0, 93.0, 0.01)), "in no unit are those of the events"),
        (circle(np.arange(0.5, 3.5, 0.01))[::-1], "must grow from line to line"),
        (circle(np.arange(0.5, 3.5, 0.01))[:, :5], "must have lines of t x y z qx qy qz qw"),
        (2 * circle(np.arange(0.5, 3.5, 0.01)), "quaternions that are not of length 1"),
        (circle(np.arange(0.98, 1.02, 0.01)), "less than 0.06 s in common"),
    ],
)
def test_what_are_no_poses_of_a_recording_is_one_sentence(tmp_path: Path, rows: np.ndarray, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        with_poses(some_recording(), written(tmp_path / "a.txt", rows), "body", 4.0)


def test_with_the_poses_of_a_flight_a_policy_decodes_what_it_did_with_the_flight(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["record", "pretrained", str(tmp_path / "a.h5"), "--world", "sparse", "--size", "64", "48"]) == 0
    known = read_events(tmp_path / "a.h5")
    flight = known.flight
    assert flight is not None
    rows = np.concatenate([1e-6 * flight["t"][:, None], flight["position"], flight["quaternion"][:, [1, 2, 3, 0]]], 1)
    written(tmp_path / "poses.txt", rows)
    unknown = Recording(known.events, known.width, known.height, contrast=known.contrast)
    policy = edqn_jax.load_policy("pretrained")
    placed = with_poses(unknown, tmp_path / "poses.txt", "body", policy.config.env.speed_m_s)
    still, found, wanted = (observe_recording(policy, each).decoded[:40] for each in (unknown, placed, known))
    offset = 1  # the flight begins with the first event, its decisions with the flight
    near = min(np.sqrt(np.mean((found[: len(wanted) - k] - wanted[k:]) ** 2)) for k in range(offset + 1))
    assert near < 0.3 * wanted.std() < np.sqrt(np.mean((still[: len(wanted)] - wanted[: len(still)]) ** 2))
    write_events(tmp_path / "a.npz", unknown)
    lens = tmp_path / "lens.yaml"
    lens.write_text(
        "cam0:\n  distortion_model: radtan\n  distortion_coeffs: [-0.05, 0, 0, 0]\n"
        "  intrinsics: [32, 32, 31.5, 23.5]\n  resolution: [64, 48]\n"
    )
    more = ["--poses", str(tmp_path / "poses.txt"), "--poses-of", "body", "--calibration", str(lens)]
    assert main(["events", str(tmp_path / "a.npz"), "--policy", "pretrained", *more]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "lens: events were rectified" in said and "m/s and" in said and "that z is up was assumed" in said


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--poses", "a.txt"], "give --policy, too"),
        (["--policy", "pretrained", "--fov", "70", "--calibration", "a.yaml"], "--fov and --calibration cannot both"),
        (["--policy", "pretrained", "--calibration", "a.yaml"], "there is no calibration 'a.yaml'"),
        (["--policy", "pretrained", "--calibration", "b.yaml"], "is of 346 x 260 pixels, and the camera has 64 x 48"),
        (["--policy", "pretrained", "--poses", "a.txt"], "there is no file of poses 'a.txt'"),
    ],
)
def test_bad_input_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, words: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_events(Path("a.npz"), some_recording())
    Path("b.yaml").write_text(
        "cam0:\n  distortion_model: none\n  intrinsics: [250, 250, 172, 130]\n  resolution: [346, 260]\n"
    )
    assert main(["events", "a.npz", *words]) == 2
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1
