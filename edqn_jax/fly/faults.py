"""What can go wrong in a flight, and how it is noticed: functions of what was last heard, with no clock or socket."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray


class Fault(enum.StrEnum):
    """What can go wrong; of several at once the first of this order counts."""

    STOPPED = "process stopped"
    TAKEN_OVER = "taken over"
    SECOND_MASTER = "second master"
    LOST_LINK = "lost link"
    CAMERA = "other camera"
    GOAL = "goal outside the fence"
    FENCE = "fence reached"
    BATTERY = "low battery"
    STALE = "stale odometry"
    JUMP = "odometry jump"
    DRIFT = "odometry drift"
    NO_EVENTS = "no events"
    BURST = "burst of events"
    COVERED = "covered lens"
    DARK = "gone dark"
    LATE = "late decision"


class Action(enum.StrEnum):
    """How a flight ends: by zero velocity from here, or by the autopilot's own hold or land mode."""

    HOVER = "hover"
    HOLD = "hold"
    LAND = "land"


ACTIONS: Mapping[Fault, Action] = {
    **dict.fromkeys(Fault, Action.HOVER),
    Fault.STOPPED: Action.HOLD,
    Fault.SECOND_MASTER: Action.HOLD,
    Fault.BATTERY: Action.LAND,
}
"""What is done about each fault unless it is configured otherwise. A flight that was taken over is left alone."""

PASSING = frozenset({Fault.STALE, Fault.NO_EVENTS, Fault.BURST, Fault.DARK, Fault.LATE})
"""Faults after which a flight goes on, once they have been gone for `Settings.clear_s`."""


@dataclasses.dataclass(frozen=True)
class Odometry:
    """Where the drone is, in the policy's world: z up, metres and m/s."""

    at: float
    """Seconds of the host's clock."""
    position: NDArray[np.float64]
    """[3]"""
    velocity: NDArray[np.float64]
    """[3]"""
    resets: int = 0
    """How often the estimator says that it jumped."""


@dataclasses.dataclass(frozen=True)
class Command:
    """What the policy wants, and when it wanted it."""

    at: float
    """Seconds of the host's clock at which its odometry and events were taken."""
    velocity: NDArray[np.float64]
    """[3] m/s in the world."""
    yaw: float
    """Radians from the world's x to the left."""


@dataclasses.dataclass(frozen=True)
class Inputs:
    """What was last heard of vehicle and camera; times are seconds of the host's clock, None before the first."""

    heartbeat_at: float | None = None
    wrong: str = ""
    """Why this vehicle cannot be flown; empty if nothing says so."""
    mode: str = "other"
    """The vehicle's: `offboard`, `hold`, `land` or `other`."""
    armed: bool = False
    airborne: bool = False
    odometry: Odometry | None = None
    packet_at: float | None = None
    """When the newest packet of the camera came, with events or without."""
    rate_hz: float = 0.0
    """Events per second over the last 100 ms."""
    darkening: float = 0.0
    """OFF events less ON ones, a pixel of the camera, over the last 200 ms."""
    camera: tuple[int, int] | None = None
    """Width and height that the camera says it has."""
    battery: float | None = None
    """Share that is left, as the autopilot tells it."""
    other_master: bool = False
    """Whether someone else has sent setpoints or changes of mode since the flight began."""
    stop: bool = False
    """Whether the process was asked to stop."""
    command: Command | None = None


@dataclasses.dataclass(frozen=True)
class Limits:
    """From where on something counts as a fault."""

    link_s: float = 3.0
    """Without a heartbeat; autopilots send one a second."""
    stale_s: float = 0.2
    """Without odometry."""
    silent_s: float = 0.1
    """Without a packet of the camera."""
    burst_hz: float = 1e7
    covered_hz: float = 0.1
    """Events per second and pixel of the camera that a drone in motion sees at least through an open lens."""
    darkening: float = 2.0
    """OFF events less ON ones, a pixel and 200 ms, from which on the whole picture has gone dark: at a contrast of 0.2
    to two thirds of its brightness. Flights through open worlds come to 0.8, a lens that is covered at once to 10 and
    more."""
    covered_s: float = 0.4
    """So long a lens that went dark, or has seen nothing yet, sees too little before it is called covered."""
    lit_s: float = 1.0
    """So long one that went dark must see enough again to count as open: the end of its going dark is no light."""
    dark_stops: bool = True
    """Whether a picture that goes dark is a fault by itself; not in logs from before it was."""
    unseen_s: float = 8.0
    """So long one that did not: blank walls, the ground and the sky show a good lens nothing for 6 s."""
    moving_m_s: float = 1.0
    """Slower ones may see nothing."""
    late_s: float = 0.1
    """Over the period a command may be held."""
    jump_m: float = 0.7
    """Of a position from where the velocity had led."""
    drift_m: float = 1.5
    """Of positions from the integral of velocities over the last `drift_s`."""
    drift_s: float = 2.0
    battery: float = 0.2
    """Share below which it is low."""
    fence_m: float = 0.0
    """From the fence's inside at which it counts as reached."""


@dataclasses.dataclass(frozen=True)
class Watch:
    """What is remembered to notice faults."""

    odometry: Odometry | None = None
    travelled: tuple[tuple[float, NDArray[np.float64], NDArray[np.float64]], ...] = ()
    """Times, positions and integrals of velocity of the last `Limits.drift_s`, a tenth of a second apart."""
    integral: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.zeros(3))
    jumped: bool = False
    drifted: bool = False
    seen_at: float | None = None
    """When the camera last saw enough, or the drone was too slow to see anything."""
    dark_at: float | None = None
    """When the whole picture last went dark."""
    lit_at: float | None = None
    """Since when it has seen enough at every step; None if it does not."""
    is_open: bool = False
    """Whether the camera has seen enough since it last went dark, so that to see nothing is no sign of a cover."""

    @property
    def is_dark(self) -> bool:
        """Whether the whole picture went dark and has not been light again."""
        return self.dark_at is not None and not self.is_open


def watch(before: Watch, inputs: Inputs, now: float, limits: Limits) -> Watch:
    """Returns what is remembered after these inputs."""
    after = _seeing(before, inputs, now, limits)
    new, old = inputs.odometry, before.odometry
    if new is None or (old is not None and new.at <= old.at):
        return after
    if old is None:
        return dataclasses.replace(after, odometry=new, travelled=((new.at, new.position, after.integral),))
    way = (old.velocity + new.velocity) / 2 * (new.at - old.at)
    integral = before.integral + way
    # A gap is told as staleness; what was flown within it is not known well enough to call it a jump.
    is_near = new.at - old.at <= limits.stale_s
    jumped = new.resets != old.resets or (
        is_near and float(np.linalg.norm(new.position - old.position - way)) > limits.jump_m
    )
    kept = tuple(entry for entry in before.travelled if entry[0] > new.at - limits.drift_s)
    if not is_near or jumped:
        kept = ()
    drift = max((float(np.linalg.norm(new.position - at - (integral - flown))) for _, at, flown in kept), default=0.0)
    if not kept or new.at - kept[-1][0] >= 0.1:
        kept = (*kept, (new.at, new.position, integral))
    return dataclasses.replace(
        after,
        odometry=new,
        travelled=kept,
        integral=integral,
        jumped=before.jumped or jumped,
        drifted=before.drifted or drift > limits.drift_m,
    )


def _seeing(before: Watch, inputs: Inputs, now: float, limits: Limits) -> Watch:
    pixels = 1 if inputs.camera is None else inputs.camera[0] * inputs.camera[1]
    moves = inputs.odometry is not None and float(np.linalg.norm(inputs.odometry.velocity)) > limits.moving_m_s
    sees, darkens = inputs.rate_hz >= limits.covered_hz * pixels, inputs.darkening >= limits.darkening
    lit_at = (now if before.lit_at is None else before.lit_at) if sees and not darkens else None
    opens = lit_at is not None and (before.dark_at is None or now - lit_at >= limits.lit_s)
    # A slow drone may see nothing, but not one whose picture went dark: a burst made it hover, and would let it go on.
    keeps = before.seen_at is not None and not sees and (moves or before.is_dark)
    return dataclasses.replace(
        before,
        seen_at=before.seen_at if keeps else now,
        dark_at=now if darkens else before.dark_at,
        lit_at=lit_at,
        is_open=not darkens and (before.is_open or opens),
    )


def faults_of(watched: Watch, inputs: Inputs, now: float, settings: Settings) -> Iterator[Fault]:
    """Yields the faults of a flight under way, in their order; not those of a mode that changed, see `machine`."""
    limits = settings.limits
    own = inputs.odometry
    found = {
        Fault.STOPPED: inputs.stop,
        Fault.SECOND_MASTER: inputs.other_master,
        Fault.LOST_LINK: is_old(inputs.heartbeat_at, now, limits.link_s),
        Fault.CAMERA: inputs.camera is not None and inputs.camera != settings.camera,
        Fault.GOAL: not is_inside(settings.goal, settings.fence),
        Fault.FENCE: own is not None and not is_inside(own.position, settings.fence, limits.fence_m),
        Fault.BATTERY: inputs.battery is not None and inputs.battery < limits.battery,
        Fault.STALE: own is None or is_old(own.at, now, limits.stale_s),
        Fault.JUMP: watched.jumped,
        Fault.DRIFT: watched.drifted,
        Fault.NO_EVENTS: is_old(inputs.packet_at, now, limits.silent_s),
        Fault.BURST: inputs.rate_hz > limits.burst_hz,
        Fault.COVERED: is_old(watched.seen_at, now, limits.unseen_s if watched.is_open else limits.covered_s),
        Fault.DARK: limits.dark_stops and watched.is_dark,
    }
    yield from (fault for fault in Fault if found.get(fault))


def is_old(at: float | None, now: float, most_s: float) -> bool:
    """Returns whether something was last heard longer ago than this, or never."""
    return at is None or now - at > most_s


def is_inside(place: NDArray[np.float64], fence: NDArray[np.float64], margin_m: float = 0.0) -> bool:
    """Returns whether a place [3] is within a box [2, 3], so far from its sides."""
    return bool(np.all(place >= fence[0] + margin_m) and np.all(place <= fence[1] - margin_m))


@dataclasses.dataclass(frozen=True)
class Settings:
    """What a flight is to do; all places are in the policy's world, metres, z up."""

    goal: NDArray[np.float64]
    """[3]"""
    fence: NDArray[np.float64]
    """[2, 3] lowest and highest corner."""
    camera: tuple[int, int]
    """Width and height that the runner was made for."""
    period_s: float
    """Of decisions."""
    goal_radius_m: float = 1.0
    actions: Mapping[Fault, Action] = dataclasses.field(default_factory=dict)
    """Of faults whose action is not that of `ACTIONS`."""
    after_hover: Action = Action.HOLD
    """What follows a hover that nothing ended."""
    at_goal: Action = Action.HOLD
    hover_s: float = 3.0
    """A flight hovers so long before `after_hover`."""
    clear_s: float = 0.5
    """A passing fault must be gone for so long before the flight goes on."""
    resumes: int = 3
    """So often a flight goes on after a fault."""
    wait_s: float = 30.0
    """For vehicle and camera."""
    flight_s: float = 300.0
    """Longest flight."""
    limits: Limits = Limits()

    def __post_init__(self) -> None:
        """Raises ValueError if a flight cannot be ended as it says."""
        for fault, what in ((Fault.STOPPED, "a stopped process"), (Fault.SECOND_MASTER, "a second master")):
            if self.action_on(fault) is Action.HOVER:
                raise ValueError(
                    f"{what} cannot be answered by hover, which needs setpoints of ours; take hold or land"
                )
        if self.after_hover is Action.HOVER:
            raise ValueError("a hover must be followed by hold or land, not by hover")

    def action_on(self, fault: Fault) -> Action:
        """Returns what is done about a fault."""
        return self.actions.get(fault, ACTIONS[fault])
