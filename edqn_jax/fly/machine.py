"""When a flight may begin, goes on, and how it ends: `step(state, inputs, now, settings)` gives state and output.

    waiting -> ready -> flying -> hovering -> holding -> ended
                          |  ^_______| |  `-> landing -> ended
                          |____________|______^

Nothing here arms a vehicle. A setpoint that moves is sent while flying alone, without any fault, and only of a command
that is younger than the period of decisions and `Limits.late_s`; in all other states it is zero velocity or none.
"""

from __future__ import annotations

import dataclasses
import enum

import numpy as np

from edqn_jax.fly.faults import (
    PASSING,
    Action,
    Fault,
    Inputs,
    Settings,
    Watch,
    faults_of,
    is_inside,
    is_old,
    watch,
)

READY_S = 0.5
"""Setpoints of zero are sent for so long before offboard mode is asked for."""

ASK_S = 0.5
"""A mode is asked for again after so long."""

REFUSED_S = 5.0
"""A vehicle that has not changed its mode by then does not."""

STILL = (0.0, 0.0, 0.0)


class Phase(enum.StrEnum):
    """Where a flight is."""

    WAITING = "waiting"
    """For vehicle, odometry and camera; nothing is sent."""
    READY = "ready"
    """Sends zero velocity and asks for offboard mode."""
    FLYING = "flying"
    """Sends what the policy decides."""
    HOVERING = "hovering"
    """Sends zero velocity."""
    HOLDING = "holding"
    """Asks for the autopilot's hold mode; sends zero velocity until it is in it."""
    LANDING = "landing"
    """As `HOLDING`, for its land mode; ends on the ground."""
    ENDED = "ended"
    """Nothing is sent any more."""


@dataclasses.dataclass(frozen=True)
class State:
    """Of a flight."""

    phase: Phase = Phase.WAITING
    since: float | None = None
    """When the phase began, host's seconds; None before the first step."""
    flying_at: float | None = None
    """When the flight began."""
    fault: Fault | None = None
    """Why it hovers, or was ended."""
    outcome: str = ""
    """Of an ended flight, or of one that is being ended: `goal`, `time out`, `refused: ...` or the fault."""
    resumes: int = 0
    clear_at: float | None = None
    """Since when a passing fault has been gone."""
    asked_at: float | None = None
    """When a mode was last asked for."""
    watched: Watch = Watch()


@dataclasses.dataclass(frozen=True)
class Output:
    """What is to be done now."""

    velocity: tuple[float, float, float] | None = None
    """Setpoint, m/s in the world; None sends none."""
    yaw: float | None = None
    """With it, radians; None keeps the heading."""
    request: str | None = None
    """Mode to ask for: `offboard`, `hold` or `land`."""
    decides: bool = False
    """Whether the policy is to decide."""


def step(state: State, inputs: Inputs, now: float, settings: Settings) -> tuple[State, Output]:
    """Returns the state after these inputs at a time, and what to send.

    Args:
        state: of the step before.
        inputs: what was last heard.
        now: host's seconds, not before those of the step before.
        settings: of the flight.
    """
    since = now if state.since is None else state.since
    watched = watch(state.watched, inputs, now, settings.limits)
    if state.phase is Phase.WAITING:
        watched = dataclasses.replace(watched, jumped=False, drifted=False)
    state = dataclasses.replace(state, since=since, watched=watched)
    return _STEPS[state.phase](state, inputs, now, settings)


def _waiting(state: State, inputs: Inputs, now: float, settings: Settings) -> tuple[State, Output]:
    wrong = _refusal(inputs, settings)
    if wrong:
        return _ended(state, now, f"refused: {wrong}")
    missing = _missing(inputs, now, settings)
    if not missing:
        return _entered(state, Phase.READY, now), Output(STILL)
    if _waited(state, now) > settings.wait_s:
        return _ended(state, now, f"refused: {missing} after {settings.wait_s:g} s")
    return state, Output()


def _refusal(inputs: Inputs, settings: Settings) -> str:
    """Returns why a flight can never begin; empty if nothing says so."""
    if inputs.stop:
        return str(Fault.STOPPED)
    if inputs.wrong:
        return inputs.wrong
    if not is_inside(settings.goal, settings.fence):
        return str(Fault.GOAL)
    if inputs.camera is not None and inputs.camera != settings.camera:
        across, down = inputs.camera
        width, height = settings.camera
        return f"the camera has {across} x {down} pixels, and the flight was prepared for {width} x {height}"
    if inputs.mode == "offboard":
        return "the vehicle is in offboard mode already: someone else flies it"
    if inputs.odometry is not None and not is_inside(inputs.odometry.position, settings.fence):
        return "the vehicle is outside the fence"
    return ""


def _missing(inputs: Inputs, now: float, settings: Settings) -> str:
    """Returns what a flight still waits for; empty if nothing."""
    limits = settings.limits
    if is_old(inputs.heartbeat_at, now, limits.link_s):
        return "no heartbeat of a vehicle"
    if inputs.odometry is None or is_old(inputs.odometry.at, now, limits.stale_s):
        return "no odometry"
    if inputs.camera is None or is_old(inputs.packet_at, now, limits.silent_s):
        return "no packets of the camera"
    if not inputs.armed:
        return "the vehicle is not armed; a pilot arms it and takes off"
    if not inputs.airborne:
        return "the vehicle is on the ground; a pilot takes off"
    if inputs.battery is not None and inputs.battery < limits.battery:
        return str(Fault.BATTERY)
    return ""


def _ready(state: State, inputs: Inputs, now: float, settings: Settings) -> tuple[State, Output]:
    fault = next(faults_of(state.watched, inputs, now, settings), None)
    waited = _waited(state, now)
    if fault is not None:
        return _ended(state, now, f"refused: {fault}")
    if inputs.mode == "offboard":
        begun = dataclasses.replace(_entered(state, Phase.FLYING, now), flying_at=now)
        return begun, Output(STILL, decides=True)
    if waited > REFUSED_S:
        return _ended(state, now, "refused: the vehicle does not enter offboard mode")
    if waited < READY_S:
        return state, Output(STILL)
    return _asking(state, now, Output(STILL), "offboard")


def _flying(state: State, inputs: Inputs, now: float, settings: Settings) -> tuple[State, Output]:
    if (ending := _common(state, inputs, now, settings)) is not None:
        return ending
    own = inputs.odometry
    assert own is not None, "odometry that never came is stale"
    if float(np.linalg.norm(own.position - settings.goal)) <= settings.goal_radius_m:
        return _finish(dataclasses.replace(state, outcome="goal"), inputs, now, settings, settings.at_goal)
    if state.flying_at is not None and now - state.flying_at > settings.flight_s:
        return _finish(dataclasses.replace(state, outcome="time out"), inputs, now, settings, settings.after_hover)
    command = inputs.command
    oldest = settings.period_s + settings.limits.late_s
    # A command of before a hover is none of this stretch of the flight; its first one may take as long as any.
    if command is None or (state.since is not None and command.at < state.since):
        if _waited(state, now) <= oldest:
            return state, Output(STILL, decides=True)
        return _answer(state, Fault.LATE, inputs, now, settings)
    if now - command.at > oldest:
        return _answer(state, Fault.LATE, inputs, now, settings)
    x, y, z = (float(each) for each in command.velocity)
    return state, Output((x, y, z), float(command.yaw), decides=True)


def _hovering(state: State, inputs: Inputs, now: float, settings: Settings) -> tuple[State, Output]:
    if inputs.mode != "offboard" and not is_old(inputs.heartbeat_at, now, settings.limits.link_s):
        return _ended(state, now, state.outcome or str(Fault.TAKEN_OVER))
    found = list(faults_of(state.watched, inputs, now, settings))
    worse = next((fault for fault in found if settings.action_on(fault) is not Action.HOVER), None)
    if worse is not None:
        return _answer(state, worse, inputs, now, settings)
    if _waited(state, now) > settings.hover_s:
        return _finish(state, inputs, now, settings, settings.after_hover)
    lasting = next((fault for fault in found if fault not in PASSING), None)
    if lasting is not None and state.fault in PASSING and not state.outcome:
        state = dataclasses.replace(state, fault=lasting)
    passes = state.fault in PASSING and state.resumes < settings.resumes and not state.outcome
    passes = passes and not state.watched.is_dark
    if not passes or found:
        return dataclasses.replace(state, clear_at=None), Output(STILL)
    clear = now if state.clear_at is None else state.clear_at
    if now - clear < settings.clear_s:
        return dataclasses.replace(state, clear_at=clear), Output(STILL)
    resumed = dataclasses.replace(_entered(state, Phase.FLYING, now), fault=None, resumes=state.resumes + 1)
    return resumed, Output(STILL, decides=True)


def _ending(state: State, inputs: Inputs, now: float, settings: Settings) -> tuple[State, Output]:
    """Returns the next step of holding or landing."""
    wanted = "hold" if state.phase is Phase.HOLDING else "land"
    waited = _waited(state, now)
    if inputs.mode == wanted:
        if wanted == "hold" or not inputs.airborne or not inputs.armed or inputs.stop:
            return _ended(state, now, state.outcome)
        return state, Output()
    if inputs.mode != "offboard" and not is_old(inputs.heartbeat_at, now, settings.limits.link_s):
        return _ended(state, now, state.outcome)  # a mode that someone else chose
    if waited > REFUSED_S:
        return _ended(state, now, f"{state.outcome}; the vehicle did not confirm {wanted}")
    return _asking(state, now, Output(STILL), wanted)


def _stay(state: State, inputs: Inputs, now: float, settings: Settings) -> tuple[State, Output]:
    return state, Output()


_STEPS = {
    Phase.WAITING: _waiting,
    Phase.READY: _ready,
    Phase.FLYING: _flying,
    Phase.HOVERING: _hovering,
    Phase.HOLDING: _ending,
    Phase.LANDING: _ending,
    Phase.ENDED: _stay,
}


def _common(state: State, inputs: Inputs, now: float, settings: Settings) -> tuple[State, Output] | None:
    """Returns the answer to the first fault of a flight, if there is one."""
    fault = next(faults_of(state.watched, inputs, now, settings), None)
    if inputs.mode != "offboard" and fault is not Fault.LOST_LINK:
        # A pilot, or the autopilot's own failsafe, has it: nothing is sent against them.
        return _ended(dataclasses.replace(state, fault=Fault.TAKEN_OVER), now, str(Fault.TAKEN_OVER))
    return None if fault is None else _answer(state, fault, inputs, now, settings)


def _answer(state: State, fault: Fault, inputs: Inputs, now: float, settings: Settings) -> tuple[State, Output]:
    action = settings.action_on(fault)
    state = dataclasses.replace(state, fault=fault)
    if action is Action.HOVER:
        return dataclasses.replace(_entered(state, Phase.HOVERING, now), clear_at=None), Output(STILL)
    return _finish(state, inputs, now, settings, action)


def _finish(state: State, inputs: Inputs, now: float, settings: Settings, action: Action) -> tuple[State, Output]:
    """Returns the first step of ending a flight."""
    outcome = state.outcome or str(state.fault)
    state = dataclasses.replace(state, outcome=outcome, asked_at=None)
    if action is Action.HOVER:
        return _entered(state, Phase.HOVERING, now), Output(STILL)
    phase = Phase.HOLDING if action is Action.HOLD else Phase.LANDING
    return _ending(_entered(state, phase, now), inputs, now, settings)


def _asking(state: State, now: float, output: Output, mode: str) -> tuple[State, Output]:
    if state.asked_at is not None and now - state.asked_at < ASK_S:
        return state, output
    return dataclasses.replace(state, asked_at=now), dataclasses.replace(output, request=mode)


def _waited(state: State, now: float) -> float:
    """Returns seconds since the phase began."""
    return 0.0 if state.since is None else now - state.since


def _entered(state: State, phase: Phase, now: float) -> State:
    return dataclasses.replace(state, phase=phase, since=now, asked_at=None)


def _ended(state: State, now: float, outcome: str) -> tuple[State, Output]:
    return dataclasses.replace(_entered(state, Phase.ENDED, now), outcome=outcome), Output()
