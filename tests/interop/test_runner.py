"""The runner flies an exported policy as JAX does, without JAX."""

from __future__ import annotations

import functools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import edqn_jax
from edqn_jax.errors import CheckError, ConfigError
from edqn_jax.evaluation.world_check import trained_sizes
from edqn_jax.extras import MissingPackageError
from edqn_jax.interop.deployment import onnx_export, runner
from edqn_jax.interop.deployment.onnx_export import RUNNER, about_policy, export_policy
from edqn_jax.learn.policy import Policy
from edqn_jax.sim.sensors.event_field import STREAM_DTYPE
from tests.support.interop.flights import Decided, flown, untrained

pytestmark = pytest.mark.filterwarnings("ignore")  # jax2onnx and what it imports

WITHOUT_JAX = """
import sys

class Refused:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("jax", "jaxlib", "edqn_jax", "flax", "mujoco", "scipy", "onnx"):
            raise ImportError(f"{name} must not be imported")

sys.meta_path.insert(0, Refused())
sys.path.insert(0, sys.argv[1])
import numpy as np
from edqn_runner import Runner

held = np.load(sys.argv[3])
flier = Runner(sys.argv[2])
moves = []
for number, until in enumerate(held["until_us"]):
    given = {name: held[name][number] for name in ("position", "quaternion", "velocity", "yaw_rate", "goal", "volume")}
    packet = held["packets"][held["first"][number] : held["first"][number + 1]]
    moves.append(flier.decide(packet, int(until), **given).move)
print(moves)
"""


@functools.cache
def pretrained() -> Policy:
    return edqn_jax.load_policy("pretrained")


def event(t: int, x: int, y: int, p: int) -> np.ndarray:
    return np.array([(t, x, y, p)], STREAM_DTYPE)


def fly(file: Path, decisions: list[Decided]) -> tuple[list[int], list[runner.Command]]:
    flier = runner.Runner(file, contrast=decisions[0].contrast)
    commands = [flier.decide(each.packet, each.until_us, **each.given) for each in decisions]
    return [command.move for command in commands], commands


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("exported") / "pretrained.onnx"
    export_policy(pretrained(), file)
    return file


@functools.cache
def whole_flight(mission: int) -> list[Decided]:
    return flown(pretrained(), "dense", mission, worlds=3)


@pytest.mark.parametrize("mission", range(3))
def test_moves_of_whole_flights_are_those_of_jax(exported, mission):
    decisions = whole_flight(mission)
    assert len(decisions) > 40
    moves, commands = fly(exported, decisions)
    assert moves == [each.move for each in decisions]
    for command, each in zip(commands, decisions, strict=True):
        # float32: the sums and sines of NumPy and XLA round differently.
        np.testing.assert_allclose(command.velocity, each.command, atol=1e-5)
        assert abs(np.angle(np.exp(1j * (command.yaw - each.setpoint)))) < 1e-5 or np.hypot(*_way(each)) < 2.0


def _way(each: Decided) -> np.ndarray:
    return (each.given["goal"] - each.given["position"])[:2]


@pytest.mark.parametrize(
    "groups",
    [
        {"events": {"law": "esim", "frame_times_s": (-0.08, -0.04, 0.0)}},
        {"events": {"leak_rate_hz": 5.0, "shot_rate_hz": 5.0}},
        {"events": {"least_contrast": 0.02, "most_contrast": 0.05, "leak_rate_hz": 1.0}},
        {"env": {"sensor": "event-image"}, "events": {"least_contrast": 0.02, "most_contrast": 0.05}},
        {"events": {"threshold": 0.08, "tolerance": 0.02}, "agent": {"history": 4, "dueling": False}},
        {"encoder": {"patch_overlap": 2}, "events": {"frame_times_s": (-0.16, -0.08, 0.0)}},
        {"env": {"sensor": "event-image"}},
        {"camera": {"mount": "body"}, "events": {"profile": "dvs", "least_contrast": 0.03, "most_contrast": 0.3}},
        {"env": {"position": False, "heading": "flight"}},
        {"encoder": {"architecture": "pooled"}, "agent": {"history": 1, "layer_norm": True}},
    ],
    ids=[
        "esim",
        "noise",
        "contrast",
        "contrast-image",
        "threshold",
        "overlap",
        "event-image",
        "body",
        "no-position",
        "pooled",
    ],
)
def test_other_policies_fly_as_in_jax(tmp_path, groups):
    policy = untrained(**groups)
    export_policy(policy, tmp_path / "policy.onnx", checks=50)
    decisions = flown(policy, most=25)
    assert sum(len(each.packet) for each in decisions) > 500
    assert fly(tmp_path / "policy.onnx", decisions)[0] == [each.move for each in decisions]


def test_it_flies_a_whole_flight_where_jax_cannot_be_imported(exported, tmp_path):
    decisions = whole_flight(0)
    packets = [each.packet for each in decisions]
    held: Any = {name: np.stack([each.given[name] for each in decisions]) for name in decisions[0].given}
    held["until_us"] = np.array([each.until_us for each in decisions])
    held["first"] = np.cumsum([0, *(len(packet) for packet in packets)])
    np.savez(tmp_path / "flight.npz", packets=np.concatenate(packets), **held)
    words = [sys.executable, "-c", WITHOUT_JAX, str(exported.parent), str(exported), str(tmp_path / "flight.npz")]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [each.move for each in decisions]


def test_own_state_and_motion_are_those_of_the_simulator():
    lean = untrained(camera={"mount": "body"})
    for policy in (pretrained(), untrained(env={"position": False, "heading": "flight"}), lean):
        about = about_policy(policy.config)
        for each in flown(policy, most=12):
            given = {name: np.asarray(value, np.float32) for name, value in each.given.items()}
            yaw, speed = runner.heading_of(given["quaternion"]), given["velocity"]
            own = runner.own_state(about, given["position"], yaw, speed, given["goal"], given["volume"])
            motion = runner.own_motion(about, yaw, speed, given["yaw_rate"], each.motion[4:7])
            motion = runner.with_lean(about, given["attitudes"], motion)
            np.testing.assert_allclose(own, each.own, atol=2e-6)  # some float32 roundings of numbers of order 1
            np.testing.assert_allclose(motion, each.motion, atol=2e-6)
    with pytest.raises(ValueError, match="leans with the body; give its 2 attitudes"):
        runner.with_lean(about_policy(lean.config), None, np.zeros(7, np.float32))


def test_the_file_says_how_large_the_worlds_of_training_were(exported):
    sizes = runner.Runner(exported).about["trained_in"]
    assert sizes == [list(size) for size in trained_sizes(pretrained().config).values()]
    assert [36, 36, 8] in sizes and len(sizes) == 6


def test_it_remembers_until_it_is_reset(exported):
    first, second = whole_flight(1)[10:12]
    flier = runner.Runner(exported)
    alone = flier.decide(second.packet, second.until_us, **second.given).values
    flier.reset()
    flier.decide(first.packet, first.until_us, **first.given)
    after = flier.decide(second.packet, second.until_us, **second.given, last_move=np.zeros(3)).values
    flier.reset()
    assert not np.array_equal(alone, after)
    assert np.array_equal(alone, flier.decide(second.packet, second.until_us, **second.given).values)


def test_events_outside_of_the_window_change_nothing(exported):
    each = whole_flight(0)[5]
    flier = runner.Runner(exported)
    others = np.concatenate([event(each.until_us, 3, 3, 1), event(each.until_us - flier.window_us - 1, 4, 4, -1)])
    wanted = flier.decide(each.packet, each.until_us, **each.given).values
    flier.reset()
    found = flier.decide(np.concatenate([others, each.packet[::-1]]), each.until_us, **each.given).values
    assert np.array_equal(found, wanted)


# ------------------------------------------------------------------------------------- another camera


def test_events_that_are_counted_before_are_those_of_the_packet(exported):
    each = next(each for each in whole_flight(0) if each.packet.size)
    flier = runner.Runner(exported)
    wanted = flier.decide(each.packet, each.until_us, **each.given).values
    first, last = (each.until_us + time for time in flier.about["frame_times_us"])
    flier.reset()
    number = flier.count(each.packet[(each.packet["t"] >= first) & (each.packet["t"] < last)])
    assert number is not None
    assert np.array_equal(flier.decide(number[None], each.until_us, **each.given).values, wanted)
    wrong = each.packet[:1].copy()
    wrong["p"] = 0
    assert flier.count(wrong) is None


ABOUT = {
    "width": 4,
    "height": 2,
    "horizontal_fov_deg": 90.0,
    "frame_times_us": [-100, 0],
    "contrast_on": 0.1,
    "contrast_off": 0.1,
    "least_count": 1,
    "counts_net": True,
}


def counts(packet: np.ndarray, camera: tuple[int, int] | None = None, **options: Any) -> np.ndarray:
    fov = options.pop("fov", None)
    return runner.count_events(
        ABOUT | options.pop("about", {}), packet, 0, grid=runner.Grid.of(ABOUT, camera, fov), **options
    )


def test_four_pixels_with_an_event_each_are_one_event():
    packet = np.concatenate([event(5, x, y, 1) for x in (2, 3) for y in (0, 1)])
    found = counts(packet, (8, 4))
    assert found[0, 0, 0, 1] == 1 and found.sum() == 1
    assert counts(packet[:3], (8, 4)).sum() == 0


def test_on_and_off_events_of_a_pixel_cancel_unless_the_policy_knows_noise():
    packet = np.concatenate([event(1, 1, 1, 1)] * 3 + [event(2, 1, 1, -1)])
    assert counts(packet)[0, :, 1, 1].tolist() == [2, 0]
    assert counts(packet, about={"counts_net": False})[0, :, 1, 1].tolist() == [3, 1]


def test_an_event_of_a_coarser_contrast_is_several():
    assert counts(event(1, 0, 0, -1), contrast=0.25)[0, :, 0, 0].tolist() == [0, 2]
    assert counts(event(1, 0, 0, -1), contrast=0.05).sum() == 0


KNOWN = {"default": 0.08, "middle": 0.1, "half_range": 2.0}


def test_a_policy_that_knows_its_contrast_counts_the_cameras_own_events_and_is_told():
    packet = np.concatenate([event(1, 0, 0, 1)] * 3)
    assert counts(packet, contrast=0.3, about={"known_contrast": KNOWN})[0, :, 0, 0].tolist() == [3, 0]
    about, own = ABOUT | {"known_contrast": KNOWN}, np.arange(3, dtype=np.float32)
    told = runner.with_contrast(about, own, runner.camera_contrast(about, 0.3))
    assert told.dtype == np.float32
    np.testing.assert_allclose(told, [0, 1, 2, np.log(3.0) / 2.0], rtol=1e-6)
    unsaid = runner.with_contrast(about, own, runner.camera_contrast(about))
    np.testing.assert_allclose(unsaid[3], np.log(0.8) / 2.0, rtol=1e-6)
    assert runner.with_contrast(ABOUT, own, 0.3) is own and runner.camera_contrast(ABOUT) is None


def test_a_policy_of_many_pixels_counts_the_mean_of_the_cameras():
    packet = np.concatenate([event(5, x, y, 1) for x in (2, 3) for y in (0, 1)][:3])
    found = counts(packet, (8, 4), about={"sensor_pixels": 100, "known_contrast": KNOWN})
    assert found[0, 0, 0, 1] == 75 and found.sum() == 75


def test_on_and_off_events_of_many_pixels_cancel_as_in_their_mean():
    about = {"sensor_pixels": 100, "known_contrast": KNOWN, "counts_net": False}
    there_and_back = np.concatenate([event(t, 2, 0, sign) for t, sign in ((1, 1), (2, 1), (3, -1))])
    assert counts(there_and_back, (8, 4), about=about)[0, :, 0, 1].tolist() == [25, 0]
    there_and_back["x"][2] = 3  # another pixel's, of the same of the policy's
    assert counts(there_and_back, (8, 4), about=about)[0, :, 0, 1].tolist() == [25, 0]
    # A camera of the policy's own pixels has been counted as the sensor that it was trained with.
    assert counts(there_and_back, about=about)[0, :, 0, 2].tolist() == [200, 0]
    assert counts(there_and_back, about=about)[0, :, 0, 3].tolist() == [0, 100]


@pytest.mark.parametrize("contrast", [0.0, -0.1, np.nan, np.inf])
def test_a_contrast_that_no_camera_has_is_refused(exported, contrast):
    with pytest.raises(ValueError, match="contrast must be more than 0"):
        runner.Runner(exported, contrast=contrast)


def test_a_wider_camera_is_cropped_and_a_narrower_one_leaves_a_margin():
    packet = np.concatenate([event(1, x, 3, 1) for x in range(16)] * 4)
    # tan(126.87 deg / 2) = 2: the middle half of the image is what the policy sees.
    wide = runner.Grid.of(ABOUT, (16, 8), 126.8699)
    assert wide.cells[4].tolist() == [-1] * 4 + [4, 4, 5, 5, 6, 6, 7, 7] + [-1] * 4
    assert runner.count_events(ABOUT, packet, 0, grid=wide).any()
    narrow = runner.Grid.of(ABOUT, (16, 8), 53.1301)
    assert (narrow.cells[0] % 4).tolist() == [1] * 8 + [2] * 8
    assert not runner.count_events(ABOUT, packet, 0, grid=narrow)[..., [0, 3]].any()


def test_pairs_of_frames_are_counted_apart():
    about = {"frame_times_us": [-100, -40, 0]}
    packet = np.concatenate([event(59, 0, 0, 1), event(60, 0, 0, 1), event(99, 0, 0, 1)])
    assert counts(packet, about=about)[:, 0, 0, 0].tolist() == [1, 2]


@pytest.mark.parametrize(
    ("packet", "says"),
    [
        (np.zeros((3, 4)), "structured array"),
        (event(1, 4, 0, 1), "outside of an image of 4 x 2"),
        (event(1, 0, 0, 0), r"must be -1 or 1; with 0 and 1, give 2 \* p - 1"),
    ],
)
def test_what_is_no_packet_is_refused(packet, says):
    with pytest.raises(ValueError, match=says):
        counts(packet)


def test_a_camera_with_too_few_pixels_is_refused():
    with pytest.raises(ValueError, match="2 x 2 pixels has fewer"):
        runner.Grid.of(ABOUT, (2, 2))
    with pytest.raises(ValueError, match="camera_fov_deg"):
        runner.Grid.of(ABOUT, (8, 4), 180.0)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"position": [0.0, np.nan, 1.0]}, "position must be 3 finite numbers"),
        ({"quaternion": [1.0, 0.0, 0.0]}, "quaternion must be 4 finite numbers"),
        ({"volume": [[0, 0, 0], [1, 0, 1]]}, "lowest and its highest corner"),
        ({"yaw_rate": np.inf}, "yaw_rate must be one finite number"),
    ],
)
def test_a_state_that_cannot_be_is_refused(exported, wrong, says):
    each = whole_flight(0)[0]
    with pytest.raises(ValueError, match=says):
        runner.Runner(exported).decide(each.packet, each.until_us, **(each.given | wrong))


@pytest.mark.parametrize("packet", [[], np.zeros((5, 2, 24, 32)), np.zeros((1, 2, 24, 31))])
def test_counts_of_another_form_are_refused(exported, packet):
    each = whole_flight(0)[0]
    with pytest.raises(ValueError, match="structured array"):
        runner.Runner(exported).decide(packet, each.until_us, **each.given)


# -------------------------------------------------------------------------------------------- export


def test_the_file_says_what_the_policy_expects(exported):
    about = runner.Runner(exported).about
    config = pretrained().config
    assert (about["width"], about["height"], about["history"]) == (32, 24, config.agent.history)
    assert about["frame_times_us"] == [-80_000, 0] and about["contrast_on"] == config.events.tolerance
    assert (
        about["checked"]["inputs"] == 1000 and about["checked"]["largest_difference"] <= 2e-5
    )  # on any CPU; 0.9e-5 on some
    assert len(about["actions"]) == len(about["action_names"]) == 27 and about["action_names"][13] == "hover"


def test_the_runner_is_written_beside_it(exported):
    assert (exported.parent / RUNNER).read_bytes() == Path(runner.__file__).read_bytes()


def test_nothing_is_written_where_onnx_and_jax_differ(tmp_path, monkeypatch):
    whole = onnx_export.decision_function
    policy, calls = untrained(), []

    def drifting(config, params):
        decide = whole(config, params)

        def changed(*given):
            calls.append(given)
            values, memory = decide(*given)
            return values + 1e-4 * (len(calls) == 1), memory  # traced for ONNX first, then for JAX

        return changed

    monkeypatch.setattr(onnx_export, "decision_function", drifting)
    with pytest.raises(CheckError, match="ONNX and JAX differ by .* nothing was written"):
        export_policy(policy, tmp_path / "policy.onnx", checks=5)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("groups", "says"),
    [
        ({"env": {"sensor": "depth"}}, "the sensor of this one is 'depth'"),
        ({"encoder": {"architecture": "pooled"}, "events": {"law": "esim"}}, "sees when each event was"),
    ],
)
def test_policies_that_see_more_than_counts_are_refused(tmp_path, groups, says):
    with pytest.raises(ConfigError, match=says):
        export_policy(untrained(**groups), tmp_path / "policy.onnx")


def test_a_missing_package_names_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jax2onnx", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'edqn-jax\[export\]'"):
        export_policy(untrained(), tmp_path / "policy.onnx")


def test_other_files_are_no_policies(tmp_path, exported):
    with pytest.raises(ValueError, match="there is no file"):
        runner.Runner(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("no policy")
    with pytest.raises(ValueError, match="is not an ONNX file"):
        runner.Runner(tmp_path / "text.onnx")


def test_a_policy_of_another_form_is_refused(exported, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "FORMAT", 2)
    with pytest.raises(ValueError, match="take the runner that was written beside it"):
        runner.Runner(exported)
