"""The state machine of a flight: each fault at random times, in virtual time."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edqn_jax.fly.faults import ACTIONS, PASSING, Action, Command, Fault, Inputs, Odometry, Settings
from edqn_jax.fly.machine import Phase, State, step
from tests.support.marks import in_whole
from tests.support.virtual_flight import CAMERA, PERIOD_S, TICK_S, Change, fly

FENCE = np.array([[-5.0, -20.0, 0.0], [100.0, 20.0, 25.0]])
GOAL = np.array([60.0, 5.0, 6.0])


def settings(**changes: Any) -> Settings:
    return Settings(**({"goal": GOAL, "fence": FENCE, "camera": CAMERA, "period_s": PERIOD_S} | changes))


def moved(inputs: Inputs, by: tuple[float, float, float], resets: int = 0) -> Inputs:
    own = inputs.odometry
    assert own is not None
    return dataclasses.replace(
        inputs, odometry=dataclasses.replace(own, position=own.position + np.array(by), resets=resets)
    )


def aged(inputs: Inputs, since: float) -> Inputs:
    own = inputs.odometry
    assert own is not None
    return dataclasses.replace(inputs, odometry=dataclasses.replace(own, at=own.at - since - TICK_S))


def covered(inputs: Inputs, since: float) -> Inputs:
    """Covers the lens at once: 20 OFF events a pixel, as of a fiftieth of the light; then noise alone."""
    return dataclasses.replace(inputs, darkening=20.0 * (since < 0.2), rate_hz=200.0)


FAULTS: dict[Fault, tuple[Change, float]] = {
    Fault.STOPPED: (lambda now, since: dataclasses.replace(now, stop=True), 0.0),
    Fault.SECOND_MASTER: (lambda now, since: dataclasses.replace(now, other_master=True), 0.0),
    Fault.LOST_LINK: (
        lambda now, since: dataclasses.replace(now, heartbeat_at=(now.heartbeat_at or 0.0) - 1.0 - since),
        3.0,
    ),
    Fault.CAMERA: (lambda now, since: dataclasses.replace(now, camera=(640, 480)), 0.0),
    Fault.FENCE: (lambda now, since: moved(now, (0.0, 0.0, 30.0)), 0.0),
    Fault.BATTERY: (lambda now, since: dataclasses.replace(now, battery=0.1), 0.0),
    Fault.STALE: (aged, 0.22),
    Fault.JUMP: (lambda now, since: moved(now, (0.0, 2.0, 0.0)), 0.0),
    Fault.DRIFT: (lambda now, since: moved(now, (0.0, since, 0.0)), 2.5),
    Fault.NO_EVENTS: (lambda now, since: dataclasses.replace(now, packet_at=(now.packet_at or 0.0) - since), 0.12),
    Fault.BURST: (lambda now, since: dataclasses.replace(now, rate_hz=2e7), 0.0),
    Fault.COVERED: (covered, 0.0),
    Fault.DARK: (lambda now, since: dataclasses.replace(now, darkening=5.0, rate_hz=2e5), 0.0),
}
"""What each fault does, and how soon it must be noticed, seconds."""

TIMES = np.random.default_rng(47).uniform(3.0, 14.0, 20)


@pytest.mark.parametrize("times", [slice(4), *in_whole(slice(4, None))], ids=["four times", "the others"])
@pytest.mark.parametrize("fault", FAULTS, ids=str)
def test_a_fault_ends_as_configured_and_never_in_a_stale_velocity(fault: Fault, times: slice) -> None:
    for time in TIMES[times]:
        ends_as_configured(fault, float(time))


def ends_as_configured(fault: Fault, time: float) -> None:
    change, noticed = FAULTS[fault]
    flown = fly(settings(), change, time)
    assert flown.state.phase is Phase.ENDED
    assert not flown.moves_after(time + noticed + TICK_S)
    assert str(fault) in flown.state.outcome
    action = ACTIONS[fault]
    assert (Phase.HOVERING in flown.phases) is (action is Action.HOVER)
    assert (Phase.LANDING in flown.phases) is (action is Action.LAND)
    assert flown.vehicle.mode == ("land" if action is Action.LAND else "hold")
    assert flown.vehicle.airborne is (action is not Action.LAND)


@pytest.mark.parametrize("fault", FAULTS, ids=str)
@pytest.mark.parametrize("action", [Action.HOLD, Action.LAND])
def test_an_action_can_be_chosen_for_each_fault(fault: Fault, action: Action) -> None:
    change, _ = FAULTS[fault]
    flown = fly(settings(actions={fault: action}), change, 6.0)
    assert flown.vehicle.mode == action
    assert (Phase.HOVERING in flown.phases) is (fault is Fault.COVERED)  # of which it is told after it has gone dark


@pytest.mark.parametrize("fault", sorted(PASSING & FAULTS.keys()), ids=str)
def test_a_flight_goes_on_after_a_passing_fault(fault: Fault) -> None:
    for time in TIMES[:3]:
        flown = fly(settings(), FAULTS[fault][0], float(time), lasts=1.0)
        assert flown.state.outcome == "goal" and flown.state.resumes == 1
        assert Phase.HOVERING in flown.phases


@pytest.mark.parametrize("fault", [Fault.JUMP, Fault.DRIFT, Fault.COVERED, Fault.CAMERA], ids=str)
def test_a_flight_does_not_go_on_after_another_fault(fault: Fault) -> None:
    flown = fly(settings(), FAULTS[fault][0], 5.0, lasts=2.5)
    assert flown.state.phase is Phase.ENDED and flown.state.outcome == fault


def test_an_open_lens_may_see_nothing_before_blank_walls_for_longer_than_a_covered_one() -> None:
    def blank(inputs: Inputs, since: float) -> Inputs:
        return dataclasses.replace(inputs, rate_hz=200.0, darkening=0.8 * (since < 0.2))

    far = settings(goal=np.array([99.0, 5.0, 6.0]))
    assert fly(far, blank, 5.0, lasts=7.0).state.outcome == "goal"
    flown = fly(far, blank, 5.0)
    assert flown.state.outcome == Fault.COVERED
    assert not flown.moves_after(5.0 + far.limits.unseen_s + 2 * TICK_S)
    assert flown.moves_after(5.0 + far.limits.unseen_s - 2 * TICK_S)


def test_a_lens_that_was_covered_before_the_flight_is_noticed() -> None:
    flown = fly(settings(), lambda inputs, since: dataclasses.replace(inputs, rate_hz=0.0), 0.0)
    assert flown.state.outcome == Fault.COVERED
    begun = flown.times[flown.phases.index(Phase.FLYING)]
    assert not flown.moves_after(begun + 0.6)  # it is above 1 m/s after 0.1 s


def test_a_shade_that_is_flown_into_is_no_cover() -> None:
    def shade(inputs: Inputs, since: float) -> Inputs:
        return dataclasses.replace(inputs, darkening=5.0 * (since < 0.3), rate_hz=200.0 if 2.0 < since < 4.0 else 2e5)

    assert fly(settings(), shade, 5.0).state.outcome == "goal"


@pytest.mark.parametrize("tail_s", [0.0, 0.15, 0.3, 0.5, 0.9])
def test_a_cover_whose_burst_makes_it_hover_does_not_let_it_go_on(tail_s: float) -> None:
    def bursts(inputs: Inputs, since: float) -> Inputs:
        rate_hz = 2e7 if since < 0.15 else 5e5 * (since < 0.15 + tail_s)
        return dataclasses.replace(covered(inputs, since), rate_hz=rate_hz)

    flown = fly(settings(), bursts, 5.0)
    assert flown.state.outcome == Fault.COVERED and flown.state.resumes == 0
    assert not flown.moves_after(5.0 + 2 * TICK_S)


def test_a_cover_that_closes_slowly_is_one() -> None:
    def closes(inputs: Inputs, since: float) -> Inputs:
        darkening = 8.0 if since < 0.6 else 8.0 * max(0.0, 0.8 - since) / 0.2
        return dataclasses.replace(inputs, darkening=darkening, rate_hz=4e6 if since < 0.7 else 200.0)

    flown = fly(settings(), closes, 5.0)
    assert flown.state.outcome == Fault.COVERED and not flown.moves_after(5.0 + 2 * TICK_S)


def test_a_passing_fault_that_comes_back_ends_the_flight() -> None:
    def flickers(inputs: Inputs, since: float) -> Inputs:
        return FAULTS[Fault.BURST][0](inputs, since) if since % 2.0 < 0.2 else inputs

    flown = fly(settings(), flickers, 3.0)
    assert flown.state.outcome == Fault.BURST and flown.state.resumes == settings().resumes


def test_a_decision_that_does_not_come_is_noticed() -> None:
    def never(inputs: Inputs, since: float) -> Inputs:
        return dataclasses.replace(inputs, command=None if since > PERIOD_S else inputs.command)

    flown = fly(settings(), never, 6.0)
    assert flown.state.outcome == Fault.LATE
    assert not flown.moves_after(6.0 + 2 * PERIOD_S + settings().limits.late_s + 2 * TICK_S)


def test_a_command_is_held_for_its_period_and_not_longer() -> None:
    flying = State(Phase.FLYING, since=0.0, flying_at=0.0)
    base = fly(settings(), seconds=4.0)
    assert Phase.FLYING in base.phases
    own = Odometry(1.0, np.array([1.0, 0.0, 5.0]), np.zeros(3))
    heard = Inputs(
        1.0,
        mode="offboard",
        odometry=own,
        packet_at=1.0,
        rate_hz=1e5,
        camera=CAMERA,
        command=Command(1.0, np.array([4.0, 0, 0]), 0.3),
    )
    state, output = step(flying, heard, 1.0, settings())
    assert output.velocity == (4.0, 0.0, 0.0) and output.yaw == 0.3
    later = 1.0 + PERIOD_S + settings().limits.late_s + 0.01
    fresh = dataclasses.replace(heard, heartbeat_at=later, packet_at=later, odometry=dataclasses.replace(own, at=later))
    state, output = step(state, fresh, later, settings())
    assert output.velocity == (0.0, 0.0, 0.0) and state.fault is Fault.LATE


def test_a_flight_to_the_goal_holds_there() -> None:
    flown = fly(settings())
    assert flown.state.outcome == "goal" and flown.vehicle.mode == "hold"
    assert np.linalg.norm(flown.vehicle.position - GOAL) < 1.5
    gaps = np.diff([at for at, sent in zip(flown.times, flown.setpoints, strict=True) if sent is not None])
    assert gaps.max() <= 0.05


def test_a_goal_may_end_in_a_landing_or_after_a_hover() -> None:
    assert fly(settings(at_goal=Action.LAND)).vehicle.mode == "land"
    flown = fly(settings(at_goal=Action.HOVER))
    assert flown.state.outcome == "goal" and Phase.HOVERING in flown.phases and flown.vehicle.mode == "hold"


def test_a_flight_that_takes_too_long_ends() -> None:
    flown = fly(settings(flight_s=4.0))
    assert flown.state.outcome == "time out" and flown.vehicle.mode == "hold"


def test_nothing_is_sent_against_a_pilot() -> None:
    def takes(inputs: Inputs, since: float) -> Inputs:
        return dataclasses.replace(inputs, mode="other")

    flown = fly(settings(), takes, 6.0)
    assert flown.state.outcome == Fault.TAKEN_OVER
    assert all(sent is None for at, sent in zip(flown.times, flown.setpoints, strict=True) if at >= 6.0)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"mode": "offboard"}, "offboard mode already"),
        ({"armed": False}, "not armed"),
        ({"airborne": False}, "on the ground"),
        ({"heartbeat_at": None}, "no heartbeat"),
        ({"odometry": None}, "no odometry"),
        ({"packet_at": None}, "no packets of the camera"),
        ({"camera": (640, 480)}, "640 x 480 pixels"),
        ({"battery": 0.1}, "low battery"),
        ({"stop": True}, "process stopped"),
        ({"wrong": "vehicle 1 is no multirotor"}, "no multirotor"),
    ],
)
def test_nothing_is_sent_to_a_vehicle_that_is_not_ready(changes: dict[str, Any], says: str) -> None:
    flown = fly(settings(wait_s=2.0), lambda inputs, since: dataclasses.replace(inputs, **changes), 0.0)
    assert flown.state.outcome.startswith("refused: ") and says in flown.state.outcome
    assert not any(flown.setpoints) and flown.vehicle.mode == "hold"


def test_a_goal_outside_the_fence_is_refused() -> None:
    flown = fly(settings(goal=np.array([200.0, 0.0, 5.0])))
    assert flown.state.outcome == f"refused: {Fault.GOAL}" and not any(flown.setpoints)


def test_a_flight_must_be_able_to_end() -> None:
    for changes in (
        {"actions": {Fault.STOPPED: Action.HOVER}},
        {"actions": {Fault.SECOND_MASTER: Action.HOVER}},
        {"after_hover": Action.HOVER},
    ):
        with pytest.raises(ValueError, match="hover"):
            settings(**changes)


finite = st.floats(-50.0, 50.0)


@st.composite
def heard(draw: st.DrawFn) -> Inputs:
    own = Odometry(
        draw(st.floats(0.0, 12.0)),
        np.array([draw(finite) for _ in range(3)]),
        np.array([draw(finite) for _ in range(3)]),
    )
    return Inputs(
        heartbeat_at=draw(st.none() | st.floats(0.0, 10.0)),
        mode=draw(st.sampled_from(["offboard", "hold", "land", "other"])),
        armed=draw(st.booleans()),
        airborne=draw(st.booleans()),
        odometry=draw(st.none() | st.just(own)),
        packet_at=draw(st.none() | st.floats(9.8, 10.0)),
        rate_hz=draw(st.floats(0.0, 2e7)),
        camera=draw(st.sampled_from([None, CAMERA, (640, 480)])),
        battery=draw(st.none() | st.floats(0.0, 1.0)),
        other_master=draw(st.booleans()),
        stop=draw(st.booleans()),
        command=draw(st.none() | st.just(Command(draw(st.floats(9.0, 10.0)), np.array([4.0, 0.0, 0.0]), 0.0))),
    )


@given(heard(), st.sampled_from(list(Phase)), st.floats(0.0, 10.0))
def test_whatever_is_heard_only_a_sound_flight_moves(inputs: Inputs, phase: Phase, since: float) -> None:
    state, output = step(State(phase, since=since, flying_at=since), inputs, 10.0, settings())
    if output.velocity is not None and any(output.velocity):
        assert phase is state.phase is Phase.FLYING and inputs.mode == "offboard" and state.fault is None
        assert not inputs.stop and not inputs.other_master and inputs.command is not None
        assert 10.0 - inputs.command.at <= PERIOD_S + settings().limits.late_s
    if state.phase is Phase.ENDED:
        assert output.velocity is None and output.request is None
    assert output.request != "offboard" or phase is Phase.READY
