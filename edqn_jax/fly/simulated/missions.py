"""Flies missions of a world over the wire: this process is the camera and the judge, two others vehicle and autopilot.

All talk as they would on a drone: the camera streams events over TCP, vehicle and autopilot speak MAVLink over UDP on
the loopback. They share a simulated clock, so that a flight does not depend on how fast the machine is.
"""

from __future__ import annotations

import bisect
import contextlib
import dataclasses
import functools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edqn_jax.config import FAMILIES, Config
from edqn_jax.evaluation.judge import MujocoWorld, clearance, load_judge, replay_contact
from edqn_jax.fly.faults import Fault, is_inside
from edqn_jax.fly.link import MODES, PX4
from edqn_jax.fly.records import RECORDS, read_records
from edqn_jax.fly.simulated.camera import EventCamera, EventServer
from edqn_jax.fly.simulated.injected import OF_VEHICLE, CameraFault, fence_of, moment_of, strike
from edqn_jax.fly.simulated.lockstep import Keeper
from edqn_jax.fly.simulated.ports import hold_udp_port
from edqn_jax.fly.simulated.vehicle import TRUTH
from edqn_jax.interop.outer import pictures
from edqn_jax.interop.outer.event_cameras import CONTRAST
from edqn_jax.interop.outer.poses import camera_rotation
from edqn_jax.sim.environment import Environment, make

MARGIN_M = 0.25
"""The autopilot's goal is so much smaller than the mission's: it knows its place no better."""

EXTRA_S = 15.0
"""Beside the longest flight: to begin and to end."""

AFTER_S = 4.0
"""So long a vehicle to which something has happened is judged without its autopilot: until it stands."""

DESCENT_M_S = 0.5
"""A vehicle that lands, and moves slower across, descends on the spot, on whatever is there: that is no collision."""


@dataclasses.dataclass(frozen=True)
class Setup:
    """What all missions share."""

    policy: Path
    """ONNX, as `edqn export` writes it."""
    size: tuple[int, int] = (346, 260)
    """Pixels of the camera."""
    frame_s: float = 0.005
    """From one picture to the next."""
    speed: float = np.inf
    """Most simulated seconds a second."""
    picture: str = "own"
    """Who draws: `own`, or `mujoco` with the patterns and the light of our own."""
    out: Path | None = None
    """Folder of the flights' logs; None keeps none."""
    pace: float = 1.0
    """As in `Pilot`."""
    autopilot: tuple[str, ...] = ()
    """More options of `edqn fly`."""
    fault: str | None = None
    """What goes wrong in each flight, of `injected.FAULTS`; None nothing."""
    fault_s: tuple[float, float] = (3.0, 8.0)
    """Between which simulated seconds, drawn for each mission."""


@dataclasses.dataclass(frozen=True)
class Mission:
    """How a mission ended."""

    number: int
    outcome: str
    """`goal`, `collision`, or what the autopilot says of a flight that it ended otherwise."""
    seconds: float
    """Simulated, from the first decision on."""
    clearance_m: float
    """Least distance of the body sphere to a solid, by C MuJoCo; 0 after a collision."""
    latency: dict[str, list[float]]
    """Median and 99th percentile of its parts, milliseconds."""
    events_hz: float
    """Mean over the flight."""
    speed: float
    """Simulated seconds a second."""
    fault_s: float | None = None
    """When the fault of `Setup.fault` struck, simulated seconds; None if there is none, or the flight had ended."""
    clearance_after_m: float | None = None
    """Least distance since then."""
    mode: str = ""
    """The vehicle's last: `offboard`, `hold`, `land` or `other`."""


@dataclasses.dataclass
class Flight:
    """What the judge knows of a flight under way."""

    judge: MujocoWorld
    goal: NDArray[np.float64]
    radius_m: float
    times: list[float] = dataclasses.field(default_factory=list)
    places: list[NDArray[np.float64]] = dataclasses.field(default_factory=list)
    reached: bool = False
    hit: bool = False
    mode: tuple[int, int] = (0, 0)
    """Of the vehicle, main and sub."""
    fault_s: float | None = None
    """When its fault struck."""
    _judged: int = 0

    def add(self, truth: bytes) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Takes where the vehicle is, and returns position [3] and attitude [4]."""
        *told, main, sub, _, _ = TRUTH.unpack(truth)
        numbers, self.mode = np.array(told), (main, sub)
        lands = self.mode == MODES[PX4]["land"] and float(np.hypot(*numbers[8:10])) < DESCENT_M_S
        if not lands or not self.places:
            self.times.append(numbers[0])
            self.places.append(numbers[1:4])
        self.reached = self.reached or bool(np.linalg.norm(numbers[1:4] - self.goal) <= self.radius_m)
        if len(self.places) - self._judged > 50:
            self.judge_now()
        return numbers[1:4], numbers[4:8]

    def judge_now(self) -> None:
        """Judges what was flown since it was last judged."""
        places = np.array(self.places[self._judged :])
        if len(places) > 1:
            self.hit = self.hit or replay_contact(self.judge, places) is not None
            self._judged = len(self.places) - 1

    def least_clearance(self, since_s: float = 0.0) -> float:
        """Returns the least distance to a solid, at every fourth pose from a time on."""
        first = min(bisect.bisect_left(self.times, since_s), len(self.times) - 1)
        return 0.0 if self.hit else min(clearance(self.judge, place)[0] for place in self.places[first::4])


@dataclasses.dataclass(frozen=True)
class Stage:
    """What happens around a flight."""

    camera: EventCamera
    server: EventServer
    frame_s: float
    longest_s: float
    wrong: CameraFault
    """What goes wrong with the camera."""
    strikes_at: float = np.inf
    """When it does, simulated seconds, or something else."""
    fence: NDArray[np.float64] | None = None
    """[2, 3] To leave it is what goes wrong, whenever that is."""
    strike: Callable[[], None] = lambda: None
    """Called then."""
    after_s: float = 0.0
    """So long the vehicle is judged after its autopilot has left, if something went wrong."""

    def comes(self, now: float, position: NDArray[np.float64] | None) -> bool:
        """Returns whether it goes wrong now, simulated seconds, with the vehicle at a position [3]."""
        return (
            now >= self.strikes_at
            if self.fence is None
            else position is not None and not is_inside(position, self.fence)
        )


def fly_missions(environment: Environment, missions: int, setup: Setup) -> Iterator[Mission]:
    """Yields how each of so many missions of an environment ended."""
    for number in range(missions):
        yield fly_mission(environment, number, setup)


def fly_mission(environment: Environment, number: int, setup: Setup) -> Mission:
    """Flies one mission and returns how it ended; where a world has fewer, the same ones again, with other errors.

    Raises:
        ConfigError: if a process does not start.
        MissingPackageError: if a package of the extra `transfer` is not installed.
    """
    config, place = environment.config, number % environment.missions
    scene = environment.scene(place)
    start, goal = np.asarray(scene.start, np.float64), np.asarray(scene.goal, np.float64)
    flight = Flight(
        load_judge(pictures.spec_of(environment, place, "plain", 0), config.drone.body_radius_m),
        goal,
        config.env.goal_radius_m,
    )
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        out = folder if setup.out is None else setup.out / f"mission-{number}"
        see = _see(environment, place, setup, stack)
        camera = EventCamera(see, lambda attitude: camera_rotation(attitude, config.camera.mount))
        server = EventServer(setup.size)
        stack.callback(server.close)
        keeper = Keeper(setup.speed)
        stack.callback(keeper.close)
        port, let_go = hold_udp_port()
        stack.callback(let_go)
        yaw = float(np.arctan2(goal[1] - start[1], goal[0] - start[0]))
        strikes_at = moment_of(setup.fault_s, number)
        words = _vehicle_words(start, yaw, port, keeper.address, number, setup.fault, strikes_at)
        vehicle = stack.enter_context(_process(words, quiet=False))
        words = _autopilot_words(config, scene, port, server.address, keeper.address, out, setup)
        autopilot = stack.enter_context(_process(words, quiet=True))
        keeper.admit({"vehicle", "autopilot"}, lambda: vehicle.poll() is None and autopilot.poll() is None)
        let_go()
        began = time.monotonic()
        longest = EXTRA_S + _mission_s(config, setup.pace)
        wrong = CameraFault(setup.fault, setup.size, setup.frame_s, number)
        stage = Stage(camera, server, setup.frame_s, longest, wrong)
        if setup.fault is not None:
            fence = fence_of(start, goal, scene.volume) if setup.fault == Fault.FENCE else None
            of_process = functools.partial(strike, autopilot, setup.fault)
            when = np.inf if fence is not None else strikes_at
            stage = dataclasses.replace(stage, strikes_at=when, fence=fence, strike=of_process, after_s=AFTER_S)
        why = _conduct(keeper, flight, stage)
        speed = keeper.now / (time.monotonic() - began)
        keeper.close()
        _wait(autopilot)
        return _judged(number, flight, out, camera.seen / max(keeper.now, 1e-9), speed, why)


def _conduct(keeper: Keeper, flight: Flight, stage: Stage) -> str:
    """Lets vehicle, camera and autopilot take their turns until the autopilot or the flight has ended.

    Returns:
        Why the flight has ended, if the autopilot does not say it.
    """
    frames, streamed, alone_s = 0, -1, None
    position = quaternion = None
    while True:
        told = keeper.collect()
        if told.get("vehicle"):
            position, quaternion = flight.add(told["vehicle"])
        members = keeper.members()
        if "autopilot" not in members and alone_s is None:
            alone_s = keeper.now
        lingers = alone_s is not None and flight.fault_s is not None and keeper.now < alone_s + stage.after_s
        if "vehicle" not in members or flight.hit or keeper.now > stage.longest_s or not (alone_s is None or lingers):
            break
        if flight.fault_s is None and alone_s is None and stage.comes(keeper.now, position):
            flight.judge_now()  # so that what was hit before is not hit after it
            if flight.hit:
                break
            flight.fault_s = keeper.now
            stage.strike()
        is_due = alone_s is None and frames * stage.frame_s <= keeper.next_wake()
        if position is not None and quaternion is not None and is_due:
            keeper.pass_time(frames * stage.frame_s)
            late_s = keeper.now - stage.strikes_at
            until, events = stage.camera.frame(keeper.now, position, quaternion, stage.wrong.light(late_s))
            if (sent := stage.wrong.sent(until, events, late_s)) is not None:
                streamed = until
                stage.server.send(until, sent)
            frames += 1
        else:
            keeper.wake_first(streamed)
    flight.judge_now()
    if keeper.now > stage.longest_s:
        return "time out"
    return "the autopilot was lost" if "vehicle" in keeper.members() else "the vehicle was lost"


def _mission_s(config: Config, pace: float) -> float:
    """Returns the longest flight of a mission, seconds."""
    return config.env.max_decisions * config.drone.physics_steps * config.drone.physics_dt_s / pace


def _judged(number: int, flight: Flight, out: Path, events_hz: float, speed: float, why: str) -> Mission:
    """Returns how a mission ended; `why` is that of a flight that the autopilot did not end."""
    records = read_records(out) if (out / RECORDS).is_file() else []
    end: dict[str, Any] = next((each for each in reversed(records) if each["kind"] == "end"), {})
    outcome = end.get("outcome", "cut off")
    if flight.hit:
        outcome = "collision"
    elif outcome == "cut off":
        outcome = why
    elif outcome == "goal" and not flight.reached:
        outcome = "beside the goal"
    seconds, latency = end.get("seconds", 0.0), end.get("latency", {})
    clearance_m, struck = flight.least_clearance(), flight.fault_s
    after_m = None if struck is None else flight.least_clearance(struck)
    mode = next((name for name, numbers in MODES[PX4].items() if numbers == flight.mode), "other")
    return Mission(number, outcome, seconds, clearance_m, latency, events_hz, speed, struck, after_m, mode)


def _see(environment: Environment, number: int, setup: Setup, stack: contextlib.ExitStack) -> pictures.See:
    config = environment.config
    lens = dataclasses.replace(config.camera, width=setup.size[0], height=setup.size[1])
    if setup.picture == "own":
        return pictures.own_pictures(dataclasses.replace(config, camera=lens), environment, number)
    drawn = pictures.mujoco_pictures(pictures.spec_of(environment, number, "own", number), lens)
    stack.callback(drawn.close)
    return drawn.see


def _vehicle_words(
    start: NDArray, yaw: float, port: int, clock: str, seed: int, fault: str | None, fault_s: float
) -> list[str]:
    place = [repr(float(each)) for each in start]
    words = ["-m", "edqn_jax.fly.simulated.vehicle", "--mavlink", f"udpout:127.0.0.1:{port}", "--start", *place]
    words += [f"--yaw={yaw!r}", "--seed", str(seed), "--clock", clock]
    return [*words, "--fault", str(fault), "--fault-s", repr(fault_s)] if fault in OF_VEHICLE else words


def _autopilot_words(
    config: Config, scene: Any, port: int, events: str, clock: str, out: Path, setup: Setup
) -> list[str]:
    def numbers(values: Any) -> list[str]:
        return [repr(float(each)) for each in np.asarray(values, np.float64).ravel()]

    fence = ()
    if setup.fault == Fault.FENCE:
        fence = ("--fence", *numbers(fence_of(scene.start, scene.goal, scene.volume)))
    return [
        *("-m", "edqn_jax", "fly", str(setup.policy)),
        *("--mavlink", f"udpin:127.0.0.1:{port}", "--events", f"tcp:{events}"),
        *("--camera", *map(str, setup.size), "--fov", repr(config.camera.horizontal_fov_deg)),
        *("--contrast", repr(CONTRAST), "--goal", *numbers(scene.goal), "--volume", *numbers(scene.volume)),
        *("--origin", *numbers(scene.start), "--goal-radius", repr(config.env.goal_radius_m - MARGIN_M)),
        *("--pace", repr(setup.pace), "--max-s", repr(_mission_s(config, setup.pace))),
        *("--out", str(out), "--clock", clock, *fence, *setup.autopilot),
    ]


@contextlib.contextmanager
def _process(words: list[str], *, quiet: bool) -> Iterator[subprocess.Popen]:
    """Runs Python with these words within the block; what it prints to stdout is not shown if `quiet`."""
    # In a group of its own: a Ctrl-C is ours to answer, and what ends here ends theirs.
    where = subprocess.DEVNULL if quiet else None
    started = subprocess.Popen([sys.executable, *words], stdout=where, start_new_session=True, env=dict(os.environ))
    try:
        yield started
    finally:
        if started.poll() is None:
            started.terminate()
        _wait(started)


def _wait(process: subprocess.Popen) -> None:
    try:
        process.wait(timeout=10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def environment_of(world: str, config: Config, missions: int, seed: int) -> Environment:
    """Returns the missions to fly: test worlds of a family, which `edqn evaluate` flies first, or that of a file.

    Raises:
        ConfigError: as `make`.
    """
    return make(world, config, worlds=missions if world in FAMILIES else 1, seed=seed, split="test")
