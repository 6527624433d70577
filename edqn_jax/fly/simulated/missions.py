"""Flies missions of a world over the wire: this process is the camera and the judge, two others vehicle and autopilot.

All talk as they would on a drone: the camera streams events over TCP, vehicle and autopilot speak MAVLink over UDP on
the loopback. They share a simulated clock, so that a flight does not depend on how fast the machine is.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edqn_jax.config import Config
from edqn_jax.evaluation.judge import MujocoWorld, clearance, load_judge, replay_contact
from edqn_jax.fly.records import RECORDS, read_records
from edqn_jax.fly.simulated.camera import EventCamera, EventServer
from edqn_jax.fly.simulated.lockstep import Keeper
from edqn_jax.fly.simulated.ports import hold_udp_port
from edqn_jax.fly.simulated.vehicle import TRUTH
from edqn_jax.interop.outer import pictures
from edqn_jax.interop.outer.event_cameras import CONTRAST
from edqn_jax.interop.outer.poses import camera_rotation
from edqn_jax.sim.environment import Environment, make

MARGIN_M = 0.25
"""The autopilot's goal is so much smaller than the mission's: it knows its place no better."""

COVERING_S = 0.02
"""A lens that is covered has a third of its light after so long."""

EXTRA_S = 15.0
"""Beside the longest flight: to begin and to end."""


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
    cover_s: float | None = None
    """Simulated seconds after which something covers the lens, within a tenth of a second; None never does."""


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
    _judged: int = 0

    def add(self, truth: bytes) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Takes where the vehicle is, and returns position [3] and attitude [4]."""
        numbers = np.array(TRUTH.unpack(truth)[:11])
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

    def least_clearance(self) -> float:
        """Returns the least distance to a solid, at every fourth pose."""
        return 0.0 if self.hit else min(clearance(self.judge, place)[0] for place in self.places[::4])


def fly_missions(environment: Environment, setup: Setup) -> Iterator[Mission]:
    """Yields how each mission of an environment ended."""
    for number in range(environment.missions):
        yield fly_mission(environment, number, setup)


def fly_mission(environment: Environment, number: int, setup: Setup) -> Mission:
    """Flies one mission and returns how it ended.

    Raises:
        ConfigError: if a process does not start.
        MissingPackageError: if a package of the extra `transfer` is not installed.
    """
    config, scene = environment.config, environment.scene(number)
    start, goal = np.asarray(scene.start, np.float64), np.asarray(scene.goal, np.float64)
    flight = Flight(
        load_judge(pictures.spec_of(environment, number, "plain", 0), config.drone.body_radius_m),
        goal,
        config.env.goal_radius_m,
    )
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        out = folder if setup.out is None else setup.out / f"mission-{number}"
        see = _covered(_see(environment, number, setup, stack), setup)
        camera = EventCamera(see, lambda attitude: camera_rotation(attitude, config.camera.mount))
        server = EventServer(setup.size)
        stack.callback(server.close)
        keeper = Keeper(setup.speed)
        stack.callback(keeper.close)
        port, let_go = hold_udp_port()
        stack.callback(let_go)
        yaw = float(np.arctan2(goal[1] - start[1], goal[0] - start[0]))
        words = _vehicle_words(start, yaw, port, keeper.address, number)
        vehicle = stack.enter_context(_process(words, quiet=False))
        words = _autopilot_words(config, scene, port, server.address, keeper.address, out, setup)
        autopilot = stack.enter_context(_process(words, quiet=True))
        keeper.admit({"vehicle", "autopilot"}, lambda: vehicle.poll() is None and autopilot.poll() is None)
        let_go()
        began = time.monotonic()
        longest = EXTRA_S + _mission_s(config, setup.pace)
        why = _conduct(keeper, camera, server, flight, setup.frame_s, longest)
        speed = keeper.now / (time.monotonic() - began)
        keeper.close()
        _wait(autopilot)
        return _judged(number, flight, out, camera.seen / max(keeper.now, 1e-9), speed, why)


def _conduct(
    keeper: Keeper, camera: EventCamera, server: EventServer, flight: Flight, frame_s: float, longest_s: float
) -> str:
    """Lets vehicle, camera and autopilot take their turns until the autopilot or the flight has ended.

    Returns:
        Why the flight has ended, if the autopilot does not say it.
    """
    frames, streamed = 0, -1
    position = quaternion = None
    while True:
        told = keeper.collect()
        if told.get("vehicle"):
            position, quaternion = flight.add(told["vehicle"])
        if keeper.members() != {"vehicle", "autopilot"} or flight.hit or keeper.now > longest_s:
            break
        if position is not None and quaternion is not None and frames * frame_s <= keeper.next_wake():
            keeper.pass_time(frames * frame_s)
            streamed, events = camera.frame(keeper.now, position, quaternion)
            server.send(streamed, events)
            frames += 1
        else:
            keeper.wake_first(streamed)
    flight.judge_now()
    if keeper.now > longest_s:
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
    return Mission(
        number, outcome, end.get("seconds", 0.0), flight.least_clearance(), end.get("latency", {}), events_hz, speed
    )


def _see(environment: Environment, number: int, setup: Setup, stack: contextlib.ExitStack) -> pictures.See:
    config = environment.config
    lens = dataclasses.replace(config.camera, width=setup.size[0], height=setup.size[1])
    if setup.picture == "own":
        return pictures.own_pictures(dataclasses.replace(config, camera=lens), environment, number)
    drawn = pictures.mujoco_pictures(pictures.spec_of(environment, number, "own", number), lens)
    stack.callback(drawn.close)
    return drawn.see


def _covered(see: pictures.See, setup: Setup) -> pictures.See:
    """Returns pictures of which the light is gone after a while; one is drawn each `frame_s`."""
    if setup.cover_s is None:
        return see
    numbers, since = itertools.count(1), setup.cover_s

    def look(position: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
        late = max(0.0, next(numbers) * setup.frame_s - since)
        return see(position, rotation) * np.exp(-late / COVERING_S)

    return look


def _vehicle_words(start: NDArray, yaw: float, port: int, clock: str, seed: int) -> list[str]:
    place = [repr(float(each)) for each in start]
    words = ["-m", "edqn_jax.fly.simulated.vehicle", "--mavlink", f"udpout:127.0.0.1:{port}", "--start", *place]
    return [*words, f"--yaw={yaw!r}", "--seed", str(seed), "--clock", clock]


def _autopilot_words(
    config: Config, scene: Any, port: int, events: str, clock: str, out: Path, setup: Setup
) -> list[str]:
    def numbers(values: Any) -> list[str]:
        return [repr(float(each)) for each in np.asarray(values, np.float64).ravel()]

    return [
        *("-m", "edqn_jax", "fly", str(setup.policy)),
        *("--mavlink", f"udpin:127.0.0.1:{port}", "--events", f"tcp:{events}"),
        *("--camera", *map(str, setup.size), "--fov", repr(config.camera.horizontal_fov_deg)),
        *("--contrast", repr(CONTRAST), "--goal", *numbers(scene.goal), "--volume", *numbers(scene.volume)),
        *("--origin", *numbers(scene.start), "--goal-radius", repr(config.env.goal_radius_m - MARGIN_M)),
        *("--pace", repr(setup.pace), "--max-s", repr(_mission_s(config, setup.pace))),
        *("--out", str(out), "--clock", clock, *setup.autopilot),
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
    """Returns the missions to fly: test worlds of a family, the first of which `edqn evaluate` flies, or one of a file.

    Raises:
        ConfigError: as `make`.
    """
    return make(world, config, worlds=missions, seed=seed, split="test")
