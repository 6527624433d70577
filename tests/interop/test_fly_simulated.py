"""`edqn fly`: a whole flight over the wire in an easy world; processes that are stopped or killed; bad input."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pymavlink")
pytest.importorskip("rotorpy")

from edqn_jax.cli import fly as command  # noqa: E402
from edqn_jax.cli import main  # noqa: E402
from edqn_jax.cli.process.signals import Stops  # noqa: E402
from edqn_jax.errors import ConfigError  # noqa: E402
from edqn_jax.fly.faults import Fault  # noqa: E402
from edqn_jax.fly.link import Link  # noqa: E402
from edqn_jax.fly.pilot import Pilot  # noqa: E402
from edqn_jax.fly.records import FlightLog, read_records  # noqa: E402
from edqn_jax.fly.simulated import missions  # noqa: E402
from edqn_jax.fly.simulated.camera import EventServer  # noqa: E402
from edqn_jax.fly.simulated.lockstep import SimulatedClock  # noqa: E402
from edqn_jax.fly.simulated.missions import Setup, environment_of, fly_mission  # noqa: E402
from edqn_jax.fly.simulated.several import fly_at_once  # noqa: E402
from edqn_jax.fly.streams import EVENT, DvStream  # noqa: E402
from edqn_jax.interop.deployment import onnx_export  # noqa: E402
from edqn_jax.interop.deployment.onnx_export import export_policy  # noqa: E402
from edqn_jax.runs.policies import load_policy  # noqa: E402
from tests.support.interop.ports import free_port  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore")  # jax2onnx, evlib, rotorpy and what they import

EASY = """
<mujoco>
  <worldbody>
    <site name="volume" type="box" pos="15 10 4" size="15 10 4" group="3"/>
    <site name="start" pos="4 10 3"/>
    <site name="goal" pos="14 10 3"/>
    <geom name="ground" type="plane" pos="15 10 0" size="15 10 0.1"/>
    <geom name="box" type="box" pos="9 16 2" size="1 1 2"/>
    <geom name="mast" type="cylinder" pos="20 6 2" size="0.5 2"/>
  </worldbody>
</mujoco>
"""

SIZE = (64, 48)
ABOUT = {"frame_times_us": [-160_000, 0]}
"""A small camera, so that the flight takes seconds."""


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("policy")
    return export_policy(load_policy("pretrained-looks"), folder / "policy.onnx", checks=20).file


@pytest.mark.slow
def test_a_mission_is_flown_over_the_wire_and_its_log_goes_the_same_way_once_more(
    exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world = tmp_path / "easy.xml"
    world.write_text(EASY)
    environment = environment_of(str(world), load_policy("pretrained-looks").config, 1, 0)
    flown = fly_mission(environment, 0, Setup(exported, out=tmp_path))  # the camera that it learnt with
    assert flown.outcome == "goal" and flown.clearance_m > 0.0 and flown.events_hz > 0.0
    assert flown.latency["computing"][0] > 0.0
    folder = tmp_path / "mission-0"
    assert read_records(folder)[-1]["kind"] == "end"
    assert main(["fly", str(exported), "--replay", str(folder)]) == 0
    assert " 0 of them with another output" in capsys.readouterr().out


@pytest.mark.slow
def test_a_lens_that_is_covered_in_flight_ends_it_in_a_hover_that_touches_nothing(
    exported: Path, tmp_path: Path
) -> None:
    world = tmp_path / "easy.xml"
    world.write_text(EASY.replace('pos="14 10 3"', 'pos="26 10 3"'))
    environment = environment_of(str(world), load_policy("pretrained-looks").config, 1, 0)
    flown = fly_mission(environment, 0, Setup(exported, out=tmp_path, fault=Fault.COVERED, fault_s=(3.0, 3.0)))
    assert flown.outcome == Fault.COVERED and flown.mode == "hold"
    assert flown.fault_s == pytest.approx(3.0, abs=0.1) and (flown.clearance_after_m or 0.0) > 0.0
    ticks = [each for each in read_records(tmp_path / "mission-0") if each["kind"] == "tick"]
    late = [each["output"]["velocity"] for each in ticks if each["now"] > 3.5]
    assert late and not any(velocity is not None and any(velocity) for velocity in late)


@pytest.mark.slow
def test_missions_that_are_flown_at_once_end_as_one_by_one(exported: Path) -> None:
    asked = "medium", load_policy("pretrained-looks").config, 2, 0
    setup = Setup(exported, SIZE, frame_s=0.01, autopilot=("--max-s", "1"))
    alone = list(missions.fly_missions(environment_of(*asked), 2, setup))
    at_once = sorted(fly_at_once(*asked, setup, jobs=2), key=lambda each: each.number)
    told = [(each.number, each.outcome, each.seconds, each.clearance_m) for each in alone]
    assert told == [(each.number, each.outcome, each.seconds, each.clearance_m) for each in at_once]
    assert [each.outcome for each in alone] == ["time out", "time out"]


def test_an_environment_that_cannot_be_made_at_once_is_one_sentence() -> None:
    nothing: Any = None
    with pytest.raises(ConfigError, match="nowhere"):
        list(fly_at_once("nowhere", load_policy("pretrained-looks").config, 2, 0, nothing, jobs=2))


class Left:
    """`Keeper`, after members have left or time has passed."""

    def __init__(self, now: float, *members: str) -> None:
        self.now, self._members = now, set(members)

    def collect(self) -> dict[str, bytes]:
        return {}

    def members(self) -> set[str]:
        return self._members


@pytest.mark.parametrize(
    ("keeper", "said", "outcome"),
    [
        (Left(20.1, "vehicle", "autopilot"), "cut off", "time out"),
        (Left(1.0, "vehicle"), "cut off", "the autopilot was lost"),
        (Left(1.0, "vehicle"), None, "the autopilot was lost"),
        (Left(1.0, "autopilot"), "cut off", "the vehicle was lost"),
        (Left(1.0, "vehicle"), "low battery", "low battery"),
    ],
)
def test_a_flight_that_is_cut_off_says_why(tmp_path: Path, keeper: Any, said: str | None, outcome: str) -> None:
    nothing: Any = None
    flight = missions.Flight(nothing, np.zeros(3), 1.0)
    flight.least_clearance = lambda since_s=0.0: 1.0
    stage = missions.Stage(nothing, nothing, 0.01, 20.0, nothing)
    why = missions._conduct(keeper, flight, stage)
    if said is not None:
        log = FlightLog(tmp_path)
        log.write("end", outcome=said)
        log.close()
    assert missions._judged(0, flight, tmp_path, 0.0, 1.0, why).outcome == outcome


@pytest.mark.parametrize("simulated", [False, True])
def test_a_connection_that_ends_is_silent_only_where_it_is_the_simulations(
    monkeypatch: pytest.MonkeyPatch, simulated: bool
) -> None:
    def fail(pilot: Pilot) -> None:
        raise ConnectionResetError("reset")

    left: list[SimulatedClock] = []
    close = SimulatedClock.close
    monkeypatch.setattr(SimulatedClock, "close", lambda clock: (left.append(clock), close(clock)))
    monkeypatch.setattr(Pilot, "fly", fail)
    unneeded = SimpleNamespace(period_s=0.26, about=ABOUT)
    monkeypatch.setattr(command, "load_runner", lambda args, size, lens: unneeded)
    server = EventServer(SIZE)
    wire = ["--events", f"tcp:{server.address}", "--mavlink", f"udpin:127.0.0.1:{free_port()}"]
    with socket.create_server(("127.0.0.1", 0)) as keeper, contextlib.ExitStack() as stack:
        clock = ["--clock", f"127.0.0.1:{keeper.getsockname()[1]}"] if simulated else []
        if not simulated:
            stack.enter_context(pytest.raises(ConnectionResetError))
        command.fly_command(command.parse_fly(["a.onnx", *wire, *ROOM, *clock]), Stops())
    server.close()
    assert len(left) == simulated


class Bench:
    """A vehicle in a process of its own, a camera that sees noise, and an observer of the vehicle."""

    def __init__(self) -> None:
        self.port, observer = free_port(), free_port()
        ends = [f"udpout:127.0.0.1:{port}" for port in (self.port, observer)]
        self.vehicle = start("edqn_jax.fly.simulated.vehicle", "--mavlink", *ends, "--start", "0", "0", "5")
        self.link = Link(f"udpin:127.0.0.1:{observer}")
        self.server = EventServer(SIZE)
        self.ended = threading.Event()
        self._thread = threading.Thread(target=self._see)
        self._thread.start()

    def _see(self) -> None:
        rng, count = np.random.default_rng(0), 200
        while not self.ended.wait(0.01):
            events, until = np.empty(count, EVENT), round(1e6 * time.monotonic())
            events["x"], events["y"] = rng.integers(0, SIZE[0], count), rng.integers(0, SIZE[1], count)
            events["t"], events["p"] = until - 1, rng.choice([-1, 1], count)
            self.server.send(until, events)

    def fly(self, exported: Path, out: Path, *words: str) -> subprocess.Popen:
        wire = ["--mavlink", f"udpin:127.0.0.1:{self.port}", "--events", f"tcp:{self.server.address}"]
        room = ["--goal", "90", "0", "5", "--volume", "-10", "-50", "-5", "100", "50", "20", "--contrast", "0.2"]
        return start("edqn_jax", "fly", str(exported), *wire, *room, "--out", str(out), *words)

    def wait_for(self, mode: str) -> None:
        """Waits until the vehicle is in a mode."""
        until = time.monotonic() + 60.0
        while self.link.inputs().mode != mode:
            assert time.monotonic() < until, f"the vehicle is in {self.link.inputs().mode}, not {mode}"
            time.sleep(0.02)
            self.link.read(time.monotonic())

    def close(self) -> None:
        self.ended.set()
        self._thread.join()
        self.server.close()
        self.link.close()
        self.vehicle.kill()
        self.vehicle.communicate()


def start(module: str, *words: str) -> subprocess.Popen:
    command = [sys.executable, "-u", "-m", module, *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=dict(os.environ))


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench()
    yield made
    made.close()


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_a_process_that_is_stopped_or_killed_leaves_a_vehicle_that_holds(
    bench: Bench, exported: Path, tmp_path: Path, number: int, code: int
) -> None:
    flight = bench.fly(exported, tmp_path / "flight")
    bench.wait_for("offboard")
    flight.send_signal(number)
    bench.wait_for("hold")
    _, said = flight.communicate(timeout=30)
    assert flight.returncode == code
    if number != signal.SIGKILL:
        first, *between, last = said.splitlines()
        assert first == "edqn fly: starting, 0:00" and "the flight was stopped: process stopped" in last
        assert all("flying" in line or "starting" in line for line in between)  # a line each two silent seconds
        assert read_records(tmp_path / "flight")[-1]["outcome"] == "process stopped"


@pytest.mark.slow
def test_a_bench_test_decides_and_the_vehicle_stays_in_its_mode(bench: Bench, exported: Path, tmp_path: Path) -> None:
    # Seven decisions take 1.8 s; a machine that stalls for 0.2 s hovers for a while, so there is twice the time.
    flight = bench.fly(exported, tmp_path / "flight", "--dry", "--max-s", "4")
    said = flight.communicate(timeout=60)[1]
    assert flight.returncode == 1 and "the flight ended with time out" in said
    records = read_records(tmp_path / "flight")
    assert sum(each["kind"] == "decision" for each in records) >= 7
    bench.link.read(time.monotonic())
    assert bench.link.inputs().mode == "hold"


ROOM = ["--goal", "9", "0", "5", "--volume", "0", "-5", "0", "20", "5", "9"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["policy", *ROOM], "'policy' must be an exported policy"),
        (["a.onnx"], "--events is missing"),
        (["a.onnx", "--events", "tcp:127.0.0.1:1", *ROOM], "there is no camera at"),
        (["a.onnx", "--events", "nowhere", *ROOM], "no camera and no file"),
        (["a.onnx", "--on", "bad weather=hold"], "there is no fault 'bad weather'"),
        (["a.onnx", "--on", "low battery=flip"], "hover, hold or land, not by 'flip'"),
        (["a.onnx", "--replay", "nowhere"], "there is no flight in 'nowhere'"),
        (["a.onnx", "--camera", "0", "4"], "--camera must be two whole numbers"),
        (["pretrained", "--simulate", "medium", "--speed", "0"], "--speed more than 0"),
        (["pretrained", "--simulate", "medium", "--jobs", "0"], "--missions and --jobs must be at least 1"),
        (["nowhere", "--simulate", "medium"], "there is no run in 'nowhere'"),
        (["a.onnx", "--simulate", "medium"], "the folder of a run, or a policy of the package"),
        (["pretrained", "--simulate", "medium", "--goal", "1", "2", "3"], "--simulate gives --goal itself"),
        (["pretrained", "--simulate", "medium", "--mavlink", "tcp:127.0.0.1:1"], "--simulate gives --mavlink itself"),
        (["pretrained", "--simulate", "medium", "--origin", "0", "0", "1"], "--simulate gives --origin itself"),
        (["pretrained", "--simulate", "medium", "--goal-radius", "2"], "--simulate gives --goal-radius itself"),
        (["pretrained", "--simulate", "medium", "--max-s", "9"], "--simulate gives --max-s itself"),
        (["pretrained", "--simulate", "medium", "--dry"], "--simulate gives --dry itself"),
        (["a.onnx", "--pace", "3"], "--pace must be from 0.2 to 1"),
        (["a.onnx", *ROOM, "--fov", "70", "--calibration", "a.yaml"], "--fov and --calibration cannot both be given"),
        (["pretrained", "--simulate", "medium", "--calibration", "a"], "--simulate gives --calibration itself"),
        (["a.onnx", "--simulate", "medium", "--replay", "b"], "give one of them"),
        (["pretrained", "--simulate", "medium", "--fault", "bad weather"], "'bad weather' cannot be simulated"),
        (["pretrained", "--simulate", "medium", "--fault", "lost lnk"], "did you mean 'lost link'?"),
        (["pretrained", "--simulate", "medium", "--fault-s", "5", "3"], "two times of at least 0, the earlier one"),
        (["pretrained", "--simulate", "medium", "--fault-s", "3", "inf"], "two times of at least 0, the earlier one"),
        (["a.onnx", "--unseen-s", "nan"], "--unseen-s more than 0"),
        (["a.onnx", *ROOM, "--fault", "lost link"], "--fault goes with --simulate"),
    ],
)
def test_bad_input_is_one_sentence(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, words: list[str], says: str
) -> None:
    monkeypatch.setattr(command, "simulate", lambda args: pytest.fail("it is said before JAX is loaded"))
    assert main(["fly", *words]) == 2
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1


def test_a_world_larger_than_those_of_training_is_warned_of_before_it_flies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ends(*_: object) -> None:
        raise ConfigError("exported")

    world = tmp_path / "wide.xml"
    world.write_text(
        '<mujoco><worldbody><site name="start" pos="3 10 3"/><site name="goal" pos="37 10 4"/>'
        '<site name="volume" type="box" pos="250 10 6" size="250 10 6"/><geom type="plane" size="0 0 1"/>'
        "</worldbody></mujoco>"
    )
    monkeypatch.setattr(onnx_export, "export_policy", ends)
    assert main(["fly", "pretrained", "--simulate", str(world)]) == 2
    assert "the flight volume of 500 × 20 × 12 m is much larger than those" in capsys.readouterr().out
    assert main(["fly", "pretrained", "--simulate", "medium"]) == 2
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--camera", "128", "96", *ROOM], "the camera has 64 x 48 pixels, and --camera says 128 x 96"),
        (["--goal", "9", "0", "5", "--volume", "0", "5", "0", "20", "-5", "9"], "lowest and its highest corner"),
        ([*ROOM, "--on", "process stopped=hover"], "cannot be answered by hover"),
        ([*ROOM, "--calibration", "nowhere.yaml"], "there is no calibration 'nowhere.yaml'"),
        ([*ROOM, "--calibration", "large.yaml"], "'large.yaml' is of 346 x 260 pixels, and the camera has 64 x 48"),
        ([*ROOM, "--mavlink", "udpin:127.0.0.1:x"], "cannot be opened"),
        (["--goal", "90", "0", "5", *ROOM[4:]], "no flight: goal outside the fence"),
    ],
)
def test_a_camera_or_a_room_that_does_not_fit_is_one_sentence(
    exported: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    says: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("large.yaml").write_text(
        "cam0:\n  distortion_model: none\n  intrinsics: [250, 250, 172, 130]\n  resolution: [346, 260]\n"
    )
    server = EventServer(SIZE)
    port = ["--mavlink", f"udpin:127.0.0.1:{free_port()}"]
    assert main(["fly", str(exported), "--events", f"tcp:{server.address}", *port, *words]) == 2
    server.close()
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1


def test_a_volume_larger_than_those_of_training_is_warned_of(
    exported: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server = EventServer(SIZE)
    there = [str(exported), "--events", f"tcp:{server.address}", "--mavlink", f"udpin:127.0.0.1:{free_port()}"]
    for far, warned in ((500, True), (100, False)):
        words = ["--goal", "900", "0", "5", "--volume", "0", "-20", "0", str(far), "20", "9"]
        assert main(["fly", *there, *words]) == 2  # the goal is outside
        said = capsys.readouterr().out
        assert ("the flight volume of 500 × 40 × 9 m is much larger than those" in said) == warned
    server.close()


def test_events_of_dv_processings_network_writer_are_read() -> None:
    pytest.importorskip("dv_processing")
    program = """
import sys, time
import dv_processing as dv

writer = dv.io.NetworkWriter("127.0.0.1", int(sys.argv[1]), dv.io.Stream.EventStream(0, "events", "CAM", (346, 260)))
print("there", flush=True)
while writer.getClientCount() == 0:
    time.sleep(0.01)
store = dv.EventStore()
for k in range(1000):
    store.push_back(1_000_000 + k, k % 346, k % 260, k % 3 == 0)
writer.writeEvents(store)
time.sleep(60)
"""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    writer = subprocess.Popen([sys.executable, "-c", program, str(port)], stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None and writer.stdout.readline() == "there\n"
    source = DvStream(f"127.0.0.1:{port}")
    until = time.monotonic() + 20.0
    while source.events.until_us < 0 and time.monotonic() < until:
        source.read(3.0)
    writer.kill()
    writer.communicate()
    source.close()
    window = source.events.window(1_000_000, 1_001_000)
    assert source.events.size == (346, 260) and window.size == 1000
    assert window["x"].tolist() == [k % 346 for k in range(1000)]
    assert np.mean(window["p"] == 1) == pytest.approx(0.334)
