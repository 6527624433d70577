"""What is made to go wrong in a simulated flight; the benchmark that flies it all."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pymavlink")
pytest.importorskip("rotorpy")

import faults  # noqa: E402
from edqn_jax.fly.faults import Fault, Limits  # noqa: E402
from edqn_jax.fly.simulated import injected  # noqa: E402
from edqn_jax.fly.simulated.injected import CameraFault, fence_of, moment_of  # noqa: E402
from edqn_jax.fly.simulated.missions import Mission, Setup, Stage  # noqa: E402
from edqn_jax.fly.streams import EVENT  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore")  # jax2onnx, rotorpy and what they import

SIZE, FRAME_S = (346, 260), 0.005
SOME = np.zeros(3, EVENT)

FAR = """
<mujoco>
  <worldbody>
    <site name="volume" type="box" pos="25 10 4" size="25 10 4" group="3"/>
    <site name="start" pos="4 10 3"/>
    <site name="goal" pos="46 10 3"/>
    <geom name="ground" type="plane" pos="25 10 0" size="25 10 0.1"/>
    <geom name="box" type="box" pos="9 16 2" size="1 1 2"/>
  </worldbody>
</mujoco>
"""


def test_a_moment_is_drawn_for_each_mission_between_two_and_is_the_same_again() -> None:
    moments = [moment_of((3.0, 8.0), number) for number in range(200)]
    assert min(moments) >= 3.0 and max(moments) <= 8.0 and np.ptp(moments) > 4.5
    assert moments[7] == moment_of((3.0, 8.0), 7)
    assert moment_of((5.0, 5.0), 3) == 5.0


def test_a_camera_is_left_alone_before_its_fault_and_by_others() -> None:
    for fault in (None, *injected.FAULTS):
        camera = CameraFault(fault, SIZE, FRAME_S, 0)
        assert camera.sent(1000, SOME, -0.001) is SOME and camera.light(-0.001) == 1.0
        if fault not in injected.OF_CAMERA:
            assert camera.sent(1000, SOME, 1.0) is SOME and camera.light(1.0) == 1.0


def test_a_camera_falls_silent_is_flooded_or_goes_dark() -> None:
    assert CameraFault(Fault.NO_EVENTS, SIZE, FRAME_S, 0).sent(1000, SOME, 0.0) is None
    flood = CameraFault(Fault.BURST, SIZE, FRAME_S, 0).sent(9000, SOME, 0.0)
    assert flood is not None and len(flood) / FRAME_S > Limits().burst_hz
    assert flood["x"].max() == SIZE[0] - 1 and flood["y"].max() == SIZE[1] - 1 and set(flood["p"]) == {-1, 1}
    assert set(flood["t"]) == {8999}
    dark = CameraFault(Fault.COVERED, SIZE, FRAME_S, 0)
    assert dark.light(0.0) == 1.0 and dark.light(0.1) < 0.01 and dark.sent(1000, SOME, 1.0) is SOME


def test_a_fence_that_is_to_be_reached_holds_start_and_goal_and_lies_in_the_volume() -> None:
    volume = np.array([[0.0, 0.0, 0.0], [30.0, 20.0, 9.0]])
    fence = fence_of([2.0, 3.0, 0.5], [20.0, 10.0, 4.0], volume)
    np.testing.assert_allclose(fence, [[1.0, 2.0, 0.0], [21.0, 11.0, 5.0]])


def test_how_a_flight_must_end() -> None:
    def mission(outcome: str, mode: str) -> Mission:
        return Mission(0, outcome, 1.0, 1.0, {}, 0.0, 1.0, fault_s=3.0, mode=mode)

    for fault in injected.FAULTS:
        (outcome, *_), mode = faults.ENDS[fault]
        assert faults.ended_as_configured(fault, mission(str(outcome), mode))
        assert not faults.ended_as_configured(fault, mission(str(outcome), "offboard"))
        assert not faults.ended_as_configured(fault, mission("goal", mode))


def test_what_counts_as_struck_and_when_its_twin_is_stopped() -> None:
    def mission(outcome: str, fault_s: float | None) -> Mission:
        return Mission(0, outcome, 1.0, 1.0, {}, 0.0, 1.0, fault_s=fault_s)

    assert faults.struck(Fault.BURST, mission("collision", 3.0)) and faults.struck(
        Fault.FENCE, mission("collision", 3.0)
    )
    # An alarm before the fault is none of it; a fence may be left by the estimate alone.
    assert not faults.struck(Fault.BURST, mission(Fault.BURST, None)) and not faults.struck(
        Fault.FENCE, mission("goal", None)
    )
    assert faults.struck(Fault.FENCE, mission(Fault.FENCE, None))
    twin = faults.stopped_at(Setup(Path("a.onnx"), fault=Fault.FENCE), 4.5)
    assert twin.fault == Fault.TAKEN_OVER and moment_of(twin.fault_s, 7) == 4.5


def test_a_fault_comes_at_its_time_or_as_the_fence_is_left() -> None:
    nothing: Any = None
    inside, outside = np.array([1.0, 1.0, 1.0]), np.array([1.0, 3.0, 1.0])
    timed = Stage(nothing, nothing, FRAME_S, 60.0, nothing, strikes_at=4.0)
    assert not timed.comes(3.9, outside) and timed.comes(4.0, None)
    fenced = dataclasses.replace(timed, strikes_at=np.inf, fence=np.array([[0.0, 0.0, 0.0], [2.0, 2.0, 2.0]]))
    assert not fenced.comes(9.0, None) and not fenced.comes(9.0, inside) and fenced.comes(0.1, outside)


@pytest.mark.slow
def test_what_strikes_the_autopilot_or_its_link_in_flight_leaves_a_vehicle_that_stands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world, file = tmp_path / "far.xml", tmp_path / "faults.json"
    world.write_text(FAR)
    kinds = [injected.KILLED, str(Fault.BATTERY)]
    assert faults.main(["--world", str(world), "--missions", "1", "--faults", *kinds, "--json", str(file)]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert [row["fault"] for row in rows] == kinds
    for row in rows:
        assert row["struck"] == row["as_configured"] == 1 and row["avoidable_collisions"] == 0
        (flown,) = row["missions"]
        assert 3.0 <= flown["fault_s"] <= 8.1 and flown["clearance_after_m"] > 0.0
    assert capsys.readouterr().out.count("| 1 of 1 | 1 | 0 | 0 |") == 2
