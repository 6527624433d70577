"""The outer test without OpenGL: events and flight of others, and the parts that are ours against the package."""

from __future__ import annotations

import dataclasses
import functools
import os
import subprocess
import sys

import numpy as np
import pytest

import edqn_jax
from edqn_jax.fly.simulated.manners import Limits
from edqn_jax.interop.deployment.runner import Command
from edqn_jax.interop.outer import event_cameras
from edqn_jax.interop.outer.poses import Track, heading_of
from edqn_jax.learn.policy import Policy
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.environment import Environment
from outer import flights

import transfer  # isort: skip

pytestmark = pytest.mark.filterwarnings("ignore")  # evlib, rotorpy, jax2onnx and what they import

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


@functools.cache
def policy() -> Policy:
    return edqn_jax.load_policy("pretrained")


@functools.cache
def medium() -> Environment:
    return edqn_jax.make("medium", policy().config, worlds=2, split="test")


def test_with_all_parts_our_own_it_flies_as_the_package_does():
    args = transfer.parse(["--world", "medium", "--picture", "own", "--missions", "2"])
    report = transfer.measure(args, show=lambda _: None)
    for mission, ended in enumerate(report["missions"]):
        state, seen = medium().reset(0, mission)
        memory, decisions = None, 0
        while not state.ended:
            move, memory = policy().act(seen, memory)
            state, step = medium().step(state, move)
            seen, decisions = step.observation, decisions + 1
        assert ended["outcome"] == edqn_jax.Outcome(int(step.outcome)).name.lower().replace("_", " ")
        assert ended["decisions"] == decisions
    assert (report["flown"], report["of"]) == (2, 2)
    assert report["median_least_clearance_m"] > 0


@pytest.mark.parametrize(
    "words, config, told",
    [
        (
            ["--mount", "body"],
            {"surface": {"pattern": "plaid"}},
            ["camera.mount level alone", "surface.pattern plaid alone; MuJoCo's picture is plain"],
        ),
        (["--picture", "own"], {"surface": {"pattern": "plaid"}}, []),
        (["--look", "textured"], {"surface": {"pattern": "drawn"}}, []),
        (["--mount", "level"], {"surface": {"pattern": "drawn"}, "camera": {"mount": "body"}}, ["flies with level"]),
    ],
)
def test_what_a_policy_never_saw_is_said(words, config, told):
    args = transfer.parse(words)
    args.mount = args.mount or edqn_jax.make_config("rooms", **config).camera.mount
    said = transfer.notes(args, edqn_jax.make_config("rooms", **config))
    assert len(said) == len(told) and all(part in each for part, each in zip(told, said, strict=True))


def rotorpy(setpoint_m_s2: float = flights.SETPOINT_M_S2, **limits: float) -> flights.RotorPyFlight:
    return flights.RotorPyFlight(np.array([0.0, 0.0, 5.0]), np.array([10.0, 0.0, 5.0]), 2.0, setpoint_m_s2, **limits)


def rotorpy_after(velocity: tuple[float, float, float], seconds: float) -> tuple[flights.RotorPyFlight, Track]:
    flight = rotorpy()
    command = Command(0, np.array(velocity, np.float32), 0.0, np.zeros(27, np.float32))
    return flight, flight.fly(command, seconds)


def test_rotorpy_hovers_and_loses_some_speed_to_drag():
    _, still = rotorpy_after((0.0, 0.0, 0.0), 1.0)
    assert np.abs(still.position - [0.0, 0.0, 5.0]).max() < 0.05
    flight, _ = rotorpy_after((4.0, 0.0, 0.0), 3.0)
    assert 3.3 < flight.body().velocity[0] < 3.95
    assert np.abs(flight.body().velocity[1:]).max() < 0.1


@pytest.mark.parametrize("limit, turned_deg", [(flights.SETPOINT_M_S2, (0, 20)), (np.inf, (60, 360))])
def test_a_setpoint_that_jumps_makes_rotorpys_controller_turn_the_drone(limit, turned_deg):
    flight, turned = rotorpy(limit), []
    for move in ACTIONS[np.random.default_rng(3).integers(0, len(ACTIONS), 8)]:
        velocity = 4 * move / max(1.0, np.linalg.norm(move))
        command = Command(0, velocity.astype(np.float32), 0.0, np.zeros(27, np.float32))
        turned += [abs(heading_of(each)) for each in flight.fly(command, 0.26).quaternion]
    least, most = np.radians(turned_deg)
    assert least <= max(turned) <= most


DESCENTS = np.array([(4.0, 0.0, 4.0), (4.0, 0.0, -4.0), (0.0, 4.0, 4.0), (-4.0, 0.0, -4.0)])


def most_lean_deg(flight: flights.RotorPyFlight) -> float:
    leans = []
    for velocity in DESCENTS:
        command = Command(0, velocity.astype(np.float32), 0.0, np.zeros(27, np.float32))
        _, x, y, _ = flight.fly(command, 0.52).quaternion.T
        leans.append(np.degrees(np.arccos(1 - 2 * (x * x + y * y))).max())
    return max(leans)


@pytest.mark.parametrize("rate", [5.0, 30.0])
def test_an_autopilots_limits_keep_rotorpys_thrust_upwards(rate):
    limits = Limits(MPC_ACC_HOR_MAX=rate).of_body()
    assert most_lean_deg(rotorpy(**limits)) < 45 + 5  # its attitude overshoots what is asked
    if rate == 30.0:
        assert most_lean_deg(rotorpy(rate)) > 90  # a descent that is faster than a fall


def test_rotorpy_turns_to_the_commanded_heading():
    flight = rotorpy()
    command = Command(0, np.zeros(3, np.float32), 1.0, np.zeros(27, np.float32))
    flight.fly(command, 0.3)
    assert flight.body().yaw_rate > 0.5
    flight.fly(command, 3.0)
    assert abs(heading_of(flight.body().quaternion) - 1.0) < 0.1


def straight_track() -> Track:
    time = np.linspace(0.0, 1.0, 11)
    return Track(time, np.stack([time, 0 * time, 0 * time], axis=1), np.tile(UPRIGHT, (11, 1)))


def test_poses_between_poses():
    position, quaternion = straight_track().at(0.55)
    np.testing.assert_allclose(position, [0.55, 0, 0], atol=1e-12)
    np.testing.assert_allclose(quaternion, UPRIGHT)


def test_esim_counts_the_change_of_log_brightness():
    """Brightness grows by a factor of e each second in one pixel: five events of 0.2 a second there, none elsewhere."""

    def see(position: np.ndarray, _: np.ndarray) -> np.ndarray:
        frame = np.full((4, 6), 0.3)
        frame[1, 2] = 0.2 * np.exp(position[0])
        return frame

    camera = event_cameras.FrameByFrame(event_cameras.esim(), see, "level")
    packet = camera.watch(straight_track(), 0.0, 1.0)
    assert {(int(each["x"]), int(each["y"]), int(each["p"])) for each in packet} == {(2, 1, 1)}
    assert 4 <= len(packet) <= 5
    assert packet["t"].min() >= 0
    assert packet["t"].max() < 1_000_000


def test_the_pixels_of_a_pair_of_frames_have_no_dead_band_where_many_stand_for_one():
    """A change of 0.3 thresholds makes no event in one pixel, and one in 0.3 of many; 1.3 make one, and 1.3."""
    law = edqn_jax.make_config(events={"threshold": 0.2, "tolerance": 0.2, "frame_times_s": (-0.1, 0.0)}).events

    def see(position: np.ndarray, _: np.ndarray) -> np.ndarray:
        frame = np.full((200, 200), 0.5)
        frame[:, :100] *= np.exp(0.6 * position[0])
        frame[:, 100:] *= np.exp(-2.6 * position[0])
        return frame

    for pixels, rising, falling in ((1, 0.0, 1.0), (117, 0.3, 1.3)):
        camera = event_cameras.PairCamera(dataclasses.replace(law, sensor_pixels=pixels), see, "level")
        packet = camera.watch(straight_track(), 0.4, 0.5)
        left = packet["x"] < 100
        assert set(packet["p"][left]) <= {1} and set(packet["p"][~left]) == {-1}
        # 20,000 pixels of each kind: the mean of their dither is within 0.02 of the change, six deviations.
        means = np.array([left.sum(), (~left).sum()]) / 20_000
        np.testing.assert_allclose(means, [rising, falling], atol=0.02 if pixels > 1 else 0.0)


@pytest.mark.parametrize("events", ["pair", "esim"])
def test_the_runner_is_told_the_contrast_of_the_camera_that_watches(events: str):
    args = transfer.parse(["--events", events])
    one, looks = policy().config, edqn_jax.load_policy("pretrained-looks").config
    assert transfer.has_fine_camera(args, looks) and transfer.has_fine_camera(args, one) is (events == "esim")
    assert transfer.contrast_of(args, looks) == 0.2
    assert transfer.contrast_of(args, one) == (None if events == "pair" else 0.2)


def test_levels_are_kept_between_windows_and_the_gap_makes_no_events():
    def see(position: np.ndarray, _: np.ndarray) -> np.ndarray:
        return np.full((2, 2), 0.1 * np.exp(2 * position[0]))

    camera = event_cameras.FrameByFrame(event_cameras.esim(), see, "level")
    camera.watch(straight_track(), 0.0, 0.1)
    packet = camera.watch(straight_track(), 0.8, 1.0)
    # 0.4 in the window is two thresholds.
    assert 1 <= len(packet) / 4 <= 2
    assert packet["t"].min() >= 800_000


def test_v2e_is_named_with_where_it_is():
    with pytest.raises(ImportError, match="github.com/SensorsINI/v2e"):
        event_cameras.v2e()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--picture", "own", "--look", "textured"], "leave it out"),
        (["--world", "romms"], "rooms"),
        (["--policy", "nowhere"], "nowhere"),
    ],
)
def test_invalid_input_is_a_sentence(capsys, words, said):
    assert transfer.main([*words, "--missions", "1"]) == 2
    shown = capsys.readouterr().err
    assert said in shown
    assert "Traceback" not in shown


@dataclasses.dataclass
class Touch:
    segment: int
    fraction: float = 0.5


def test_a_flight_that_meets_goal_and_wall_in_one_decision_ends_with_what_came_first():
    config = policy().config
    places = np.array([[0.0, 0, 1], [1, 0, 1], [2, 0, 1], [3, 0, 1]])
    volume = np.array([[-5.0, -5, 0], [5, 5, 5]])

    far = np.array([3 + config.env.goal_radius_m, 0, 1])
    assert transfer._outcome(config, places, far, volume, None) == "goal"
    assert transfer._outcome(config, places, far, volume, Touch(1)) == "collision"
    assert transfer._outcome(config, places, far + [9, 0, 0], volume, None) is None


@pytest.mark.parametrize(
    "words",
    [
        [transfer.__file__, "--missions", "1"],
        ["-m", "edqn_jax", "fly", "pretrained-looks", "--simulate", "rooms", "--picture", "mujoco"],
    ],
    ids=["transfer", "fly"],
)
def test_without_opengl_it_is_named_with_what_brings_it(words):
    # MuJoCo looks for OpenGL as it is imported, so only a process of its own can tell.
    environment = os.environ | {"MUJOCO_GL": "none-such", "PYTHONPATH": os.pathsep.join(sys.path)}
    ended = subprocess.run([sys.executable, *words], env=environment, capture_output=True, text=True, timeout=120)
    said = [line for line in ended.stderr.splitlines() if not line.startswith(("edqn fly: ", "transfer: ", "  "))]
    assert ended.returncode == 2 and len(said) == 1
    assert "MUJOCO_GL='none-such'" in said[0] and "install EGL (Debian: libegl1)" in said[0]
