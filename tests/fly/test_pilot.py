"""The loop of a flight, with a policy, a vehicle and a camera of a few lines each, in virtual time; and its log."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edqn_jax.cli import fly as command
from edqn_jax.errors import ConfigError
from edqn_jax.fly.faults import Fault, Inputs, Watch, faults_of, watch
from edqn_jax.fly.machine import Phase
from edqn_jax.fly.pilot import LATE_S, PATIENCE_S, TICK_S
from edqn_jax.fly.records import EVENTS, RECORDS, FlightLog, inputs_of, read_records, settings_of
from edqn_jax.fly.replay import replay
from edqn_jax.fly.streams import EVENT, read_stream
from edqn_jax.fly.tally import events_at_pace
from edqn_jax.interop.deployment.runner import Command
from edqn_jax.interop.recordings.lens import Lens
from tests.support.virtual_flight import CAMERA, PERIOD_S
from tests.support.virtual_pilot import SETTINGS, Camera, Policy, Time, Wire, make


def test_a_flight_reaches_its_goal_and_sends_what_was_decided() -> None:
    policy = Policy()
    pilot, wire = make(policy)
    report = pilot.fly()
    assert report.outcome == "goal" and wire.asked == ["offboard", "hold"] and policy.resets == 1
    moving = [each for each in wire.sent if each[1] is not None and any(each[1])]
    assert {each[1:] for each in moving} == {((3.0, 0.0, 0.0), 0.25)}
    gaps = np.diff([now for now, velocity, _ in wire.sent if velocity is not None])
    assert gaps.max() < 0.05 and report.longest_gap_s == pytest.approx(gaps.max())
    assert report.decisions == pytest.approx(report.seconds / PERIOD_S, abs=1.5)
    parts = report.latency.percentiles()
    assert parts["all"][0] >= parts["computing"][0] >= parts["decide"][0] > 0.0


def test_a_log_is_played_again_with_the_same_outputs_and_moves(tmp_path: Path) -> None:
    log = FlightLog(tmp_path / "flight")
    pilot, _ = make(log=log)
    report = pilot.fly()
    log.close()
    again = replay(tmp_path / "flight", Policy())  # pyright: ignore[reportArgumentType]
    assert (again.other_outputs, again.other_moves, again.outcome) == (0, 0, "goal")
    assert again.decisions == report.decisions and again.ticks > 100
    file = tmp_path / "flight" / RECORDS
    lines = file.read_text().splitlines()
    number = next(k for k, line in enumerate(lines) if json.loads(line)["kind"] == "decision")
    lines[number] = json.dumps(json.loads(lines[number]) | {"move": 99})
    file.write_text("\n".join(lines) + "\n{cut off")
    assert replay(tmp_path / "flight", Policy()).other_moves == 1  # pyright: ignore[reportArgumentType]


def test_a_log_from_before_lenses_were_told_apart_keeps_its_rule(tmp_path: Path) -> None:
    log = FlightLog(tmp_path / "flight")
    make(log=log)[0].fly()
    log.close()
    record = next(each for each in read_records(tmp_path / "flight") if each["kind"] == "settings")["settings"]
    assert settings_of(record).limits == SETTINGS.limits
    for new in ("unseen_s", "darkening", "lit_s", "dark_stops"):
        del record["limits"][new]
    old = settings_of(record)
    assert old.limits.unseen_s == SETTINGS.limits.covered_s
    dark, now = Inputs(camera=SETTINGS.camera, darkening=9.0, rate_hz=1e6), 1.0
    for settings, stops in ((SETTINGS, True), (old, False)):
        watched = watch(Watch(), dark, now, settings.limits)
        assert watched.is_dark and (Fault.DARK in faults_of(watched, dark, now, settings)) is stops


class Packets(Camera):
    """A camera that sends a packet now and then, until it ends."""

    def __init__(self, time: Time, every_s: float, ends_at: float = np.inf) -> None:
        super().__init__()
        self._time, self._every_s, self._ends, self._sent = time, every_s, ends_at, -1

    def read(self, now: float, least_us: int = -1) -> None:
        while (self._sent + 1) * self._every_s <= min(now, self._ends) + 1e-9:
            self._sent += 1
            events = np.zeros(1000, EVENT)
            until = round(1e6 * self.shows(self._sent * self._every_s))
            events["t"], events["p"] = until - 1, 1
            self.events.add(events, until, now)

    def wait(self, most_s: float) -> None:
        following = (self._sent + 1) * self._every_s if self._time.moment < self._ends else np.inf
        self._time.moment = min(self._time.moment + most_s, following)


@pytest.mark.parametrize(
    ("every_s", "oldest_s"), [(0.007, 0.0), (0.02, 0.02 - PATIENCE_S), (0.033, 0.033 - PATIENCE_S)]
)
def test_a_decision_waits_for_a_packet_that_is_to_come_soon(every_s: float, oldest_s: float) -> None:
    time, ages = Time(), []
    time.passes = True

    class Ages(Policy):
        def decide(self, packet: np.ndarray, until_us: int, **own: Any) -> Command:
            ages.append(time.moment + 7.0 - 1e-6 * until_us)  # by the camera's clock
            return super().decide(packet, until_us, **own)

    pilot, _ = make(Ages(), camera=Packets(time, every_s), clock=time)
    report = pilot.fly()
    assert report.outcome == "goal" and len(ages) > 10
    # The first decision does not wait: it is made as soon as the vehicle is in offboard mode.
    assert max(ages[1:]) <= oldest_s + 1e-5
    np.testing.assert_allclose(report.latency.age[1:], 1e3 * np.array(ages[1:]), atol=0.01)


def test_a_camera_that_ends_is_waited_for_no_longer_than_its_next_packet_is_late() -> None:
    time = Time()
    time.passes = True
    pilot, wire = make(camera=Packets(time, 0.007, ends_at=time.now() + 1.0), clock=time)
    pilot.fly()
    gaps = np.diff([now for now, velocity, _ in wire.sent if velocity is not None])
    assert pilot.state.fault is Fault.NO_EVENTS and gaps.max() < TICK_S + PATIENCE_S + LATE_S + 0.004 + 1e-6


LENS = Lens((64, 48), (60.0, 60.0, 32.0, 24.0), "radtan", (-0.1, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("flown", "words", "told"),
    [
        ({"fov_deg": 70.0}, [], (70.0, 0.15, None)),
        ({"fov_deg": 70.0}, ["--fov", "80"], (80.0, 0.15, None)),
        ({"lens": LENS}, [], (None, 0.15, LENS)),
        ({"lens": LENS}, ["--fov", "80"], (80.0, 0.15, None)),
        ({"fov_deg": 70.0}, ["--calibration", "lens.yaml"], (None, 0.15, LENS)),
    ],
)
def test_a_replay_knows_the_camera_of_the_flight_unless_it_is_told_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flown: dict[str, Any], words: list[str], told: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lens.yaml").write_text(
        "cam0:\n  distortion_model: radtan\n  distortion_coeffs: [-0.1, 0, 0, 0]\n"
        "  intrinsics: [60, 60, 32, 24]\n  resolution: [64, 48]\n"
    )
    log = FlightLog(tmp_path)
    pilot, _ = make(log=log, contrast=0.15, **flown)
    pilot.fly()
    log.close()
    seen: list[Any] = []
    monkeypatch.setattr(
        command, "load_runner", lambda args, size, lens: seen.append((args.fov, args.contrast, lens)) or Policy()
    )
    command.replay(command.parse_fly(["a.onnx", "--replay", str(tmp_path), *words]), tmp_path)
    assert seen == [told]


class Restarted(Camera):
    """A camera whose clock begins anew at 52 s."""

    def shows(self, now: float) -> float:
        return now + 7.0 if now < 52.0 else now - 51.8


def test_events_after_the_cameras_clock_began_anew_are_logged_and_played_again(tmp_path: Path) -> None:
    log = FlightLog(tmp_path)
    pilot, _ = make(camera=Restarted(), log=log)
    report = pilot.fly()
    log.close()
    ends = [until for until, _ in read_stream(tmp_path / EVENTS)]
    assert min(ends) < 1e6 < max(ends) and sum(np.diff(ends) < 0) == 1
    again = replay(tmp_path, Policy())  # pyright: ignore[reportArgumentType]
    assert (again.decisions, again.other_moves, again.outcome) == (report.decisions, 0, "goal")


def test_a_mode_that_was_chosen_before_the_flight_is_of_no_second_master() -> None:
    class Steered(Wire):
        steered = True

        def inputs(self) -> Inputs:
            return dataclasses.replace(super().inputs(), other_master=self.steered)

        def forget_masters(self) -> None:
            self.steered = False

    pilot, _ = make(wire=Steered())
    assert pilot.fly().outcome == "goal"


def test_inputs_and_settings_come_back_from_a_log(tmp_path: Path) -> None:
    log = FlightLog(tmp_path)
    heard = dataclasses.replace(Wire().inputs(), camera=CAMERA, battery=0.5)
    log.write("tick", inputs=heard)
    log.write("settings", settings=dataclasses.replace(SETTINGS, actions={Fault.BATTERY: "hold"}))
    log.close()
    tick, settings = read_records(tmp_path)
    assert repr(inputs_of(tick["inputs"])) == repr(heard)
    assert settings_of(settings["settings"]).action_on(Fault.BATTERY) == "hold"
    assert settings_of(settings["settings"]).limits == SETTINGS.limits


def test_a_camera_that_falls_silent_ends_in_a_hover_and_then_hold() -> None:
    pilot, wire = make(camera=Camera(ends_at=52.5))
    report = pilot.fly()
    assert report.outcome == Fault.NO_EVENTS and wire.asked == ["offboard", "hold"]
    late = [velocity for now, velocity, _ in wire.sent if now > 52.5 + 0.14 and velocity is not None]
    assert late and not any(any(velocity) for velocity in late)


def test_a_policy_that_cannot_decide_does_not_move() -> None:
    pilot, wire = make(Policy(ValueError("an event is at pixel (400, 3)")))
    assert pilot.fly().outcome == Fault.LATE
    assert not any(velocity is not None and any(velocity) for _, velocity, _ in wire.sent)


def test_a_fault_of_ours_asks_for_hold_and_is_not_hidden(tmp_path: Path) -> None:
    log = FlightLog(tmp_path)
    pilot, wire = make(Policy(ZeroDivisionError("ours")), log=log)
    with pytest.raises(ZeroDivisionError):
        pilot.fly()
    log.close()
    assert wire.asked == ["offboard", "hold"] and read_records(tmp_path)[-1]["outcome"] == "cut off"


def test_a_process_that_is_stopped_asks_for_hold() -> None:
    asked = iter(range(10_000))
    pilot, wire = make(stop=lambda: next(asked) > 150)
    assert pilot.fly().outcome == Fault.STOPPED
    assert wire.asked == ["offboard", "hold"] and wire.vehicle.mode == "hold"


def test_a_bench_test_decides_and_moves_nothing() -> None:
    pilot, wire = make(wire=Wire(armed=False), dry=True, settings=dataclasses.replace(SETTINGS, flight_s=3.0))
    report = pilot.fly()
    assert report.outcome == "time out" and report.decisions == 12 and wire.asked == []
    assert {velocity for _, velocity, _ in wire.sent} == {None, (0.0, 0.0, 0.0)}


def test_a_log_is_not_written_over_and_no_log_is_one_sentence(tmp_path: Path) -> None:
    FlightLog(tmp_path).close()
    with pytest.raises(ConfigError, match="holds a flight already"):
        FlightLog(tmp_path)
    with pytest.raises(ConfigError, match="no flight in"):
        read_records(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="cut off before it began"):
        replay(tmp_path)
    (tmp_path / RECORDS).write_text("{}\nnot json\n{}\n")
    with pytest.raises(ConfigError, match="is damaged"):
        read_records(tmp_path)


def test_a_log_that_cannot_be_begun_leaves_no_file_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Any] = []
    once = Path.open
    monkeypatch.setattr(Path, "open", lambda *args, **more: opened.append(once(*args, **more)) or opened[-1])
    (tmp_path / EVENTS).touch()
    with pytest.raises(ConfigError, match="holds a flight already"):
        FlightLog(tmp_path)
    assert [each.closed for each in opened] == [True]


def test_at_half_the_pace_a_policy_sees_and_is_told_what_it_would_at_its_own() -> None:
    told: list[dict[str, Any]] = []

    class Asked(Policy):
        def decide(self, packet: np.ndarray, until_us: int, **own: Any) -> Command:
            told.append(own | {"since": until_us - int(packet["t"].min())})
            return super().decide(packet, until_us, **own)

    pilot, wire = make(Asked(), pace=0.5, settings=dataclasses.replace(SETTINGS, period_s=2 * PERIOD_S))
    report = pilot.fly()
    assert report.outcome == "goal"
    sent = [each for each in wire.sent if each[1] is not None and any(each[1])]
    assert {velocity for _, velocity, _ in sent} == {(1.5, 0.0, 0.0)}
    assert told[-1]["velocity"][0] == pytest.approx(3.0, abs=0.01) and told[-1]["since"] <= Policy.window_us
    assert told[-1]["since"] > 0.8 * Policy.window_us
    assert report.decisions == pytest.approx(report.seconds / (2 * PERIOD_S), abs=1.5)
    events = np.zeros(3, EVENT)
    events["t"] = [1000, 1500, 1999]
    assert events_at_pace(events, 2000, 0.5)["t"].tolist() == [1500, 1750, 1999]


def test_the_phases_are_told() -> None:
    told: list[str] = []
    pilot, _ = make()
    pilot._tell = told.append
    pilot.fly()
    assert [line.split(": ")[1].split(" ")[0] for line in told] == [
        Phase.READY, Phase.FLYING, Phase.HOLDING, Phase.ENDED,
    ]  # fmt: skip
