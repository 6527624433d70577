"""N drones in one process: physics, outcome, pictures, events and label of all of them in compiled loops."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray

from conventional_stack import events, flight, task, world
from conventional_stack.cameras.columns import ColumnCamera
from conventional_stack.cameras.rays import RayCamera
from conventional_stack.stopwatch import Stopwatch
from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.learn.perception.vae import needs_nearness
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.physics import disturbances
from edqn_jax.sim.scene.scene import take_scene
from edqn_jax.sim.sensors import light
from edqn_jax.sim.sensors.sensor import frame_steps
from edqn_jax.sim.task import env
from edqn_jax.sim.task.observation import MOTION_SIZE, OWN_SIZE

CAMERAS = {"rays": RayCamera, "columns": ColumnCamera}
"""Cameras by name."""


@dataclass(frozen=True)
class Course:
    """One world, and the missions that are drawn from."""

    mjcf: str  # see `world.text_of`
    start: NDArray[np.float64]  # [M, 3] metres
    goal: NDArray[np.float64]  # [M, 3] metres

    @classmethod
    def of(cls, ours: env.EnvParams) -> Course:
        """Returns the missions of our environments.

        Raises:
            ConfigError: if they are in several worlds.
        """
        worlds = ours.pool.start.shape[0]
        if worlds != 1:
            raise ConfigError(f"the conventional stack supports one world, 'paper' or an MJCF file, not {worlds}")
        scene = jax.tree.map(np.asarray, take_scene(ours.pool, 0))
        start, goal = (np.asarray(points, np.float64) for points in (ours.missions.start, ours.missions.goal))
        return cls(mjcf=world.text_of(scene), start=start, goal=goal)


@dataclass(frozen=True)
class Record:
    """Actions and results of a step of N drones; the arrays may be shared between processes."""

    action: np.ndarray  # [N] int64 of the next step
    events: np.ndarray  # [N, H, W] int8 signed counts of the window before the next decision
    motion: np.ndarray  # [N, 7] float32 at the end of that window, see `edqn_jax.sim.task.observation.own_motion`
    nearness: np.ndarray  # [N, H, W] float32 at the end of that window, if the VAE must draw it; otherwise [N, 0, 0]
    own: np.ndarray  # [N, 10] float32 see `edqn_jax.sim.task.observation.own_state`
    final_own: np.ndarray  # [N, 10] float32 the same before drones whose episode ended were reset
    reward: np.ndarray  # [N] float32
    outcome: np.ndarray  # [N] int64 an `Outcome`; other than RUNNING, the drone has been reset

    @classmethod
    def shapes(cls, config: Config, drones: int) -> dict[str, tuple[tuple[int, ...], str]]:
        """Returns shape and type of every array."""
        image = config.camera.height, config.camera.width
        return {
            "action": ((drones,), "i8"),
            "events": ((drones, *image), "i1"),
            "motion": ((drones, MOTION_SIZE), "f4"),
            "nearness": ((drones, *(image if needs_nearness(config.encoder) else (0, 0))), "f4"),
            "own": ((drones, OWN_SIZE), "f4"),
            "final_own": ((drones, OWN_SIZE), "f4"),
            "reward": ((drones,), "f4"),
            "outcome": ((drones,), "i8"),
        }

    @classmethod
    def empty(cls, config: Config, drones: int) -> Record:
        """Allocates the arrays in this process."""
        return cls(**{name: np.zeros(shape, kind) for name, (shape, kind) in cls.shapes(config, drones).items()})

    def part(self, drones: slice) -> Record:
        """Returns the record of some drones, as views."""
        return Record(**{name: array[drones] for name, array in vars(self).items()})


def check(config: Config) -> None:
    """Raises ConfigError if this stack does not support the configuration."""
    sensor = config.events
    noisy = (sensor.threshold_mismatch, sensor.leak_rate_hz, sensor.shot_rate_hz, sensor.hot_pixel_fraction)
    if sensor.law != "paper" or len(sensor.frame_times_s) != 2 or any(noisy) or sensor.bandwidth_hz:
        raise ConfigError("the conventional stack supports only the noiseless 'paper' event law between two frames")
    if light.is_on(config.light):
        raise ConfigError("the conventional stack supports only events without light; set light.most_lux to 0")
    if sensor.most_contrast or sensor.sensor_pixels > 1:
        raise ConfigError(
            "the conventional stack supports only one contrast and one sensor pixel for each of ours; set "
            "events.most_contrast to 0 and events.sensor_pixels to 1"
        )
    if config.encoder.retrain_at:
        raise ConfigError(
            "the conventional stack supports only a VAE that is trained once; leave encoder.retrain_at empty"
        )
    if config.camera.mount != "level":
        raise ConfigError("the conventional stack supports only a level camera; set camera.mount to 'level'")
    if not config.env.position:
        raise ConfigError(
            "the conventional stack supports only a drone that knows its position; set env.position to true"
        )
    if config.env.reward == "geodesic":
        raise ConfigError(
            "the conventional stack supports only rewards of straight metres; set env.reward to 'progress'"
        )
    if config.env.drones > 1:
        raise ConfigError("the conventional stack supports only drones that fly alone; set env.drones to 1")
    if disturbances.any_on(config):
        raise ConfigError(
            "the conventional stack supports only undisturbed flights; leave air, body, motors, noise and "
            "env.action_delay as they are"
        )


class Fleet:
    """N drones. `step` reads `record.action` and fills the rest of `record`.

    Until the next step `path` holds the poses, and `end_step` and `contact` are as in `edqn_jax.sim.task.env.Step`.
    """

    def __init__(self, config: Config, course: Course, record: Record, seed: int, camera: str = "rays") -> None:
        """Allocates all arrays; `record` has one row for each drone, `camera` is one of `CAMERAS`.

        Raises:
            ConfigError: if this stack does not support the configuration.
        """
        check(config)
        self.course, self.record = course, record
        self.stopwatch = Stopwatch()
        self.world = world.compiled(course.mjcf)
        self.engine = flight.load_engine(config.drone)
        self.airframe = flight.airframe_of(config.drone, self.engine.model)
        self.command = flight.command_of(config, ACTIONS)
        self.rules = task.rules_of(config)
        self.law = events.law_of(config.events)
        self.random = np.random.default_rng(seed)

        drones, steps = len(record.action), config.drone.physics_steps
        self.state = np.zeros((drones, flight.STATE))
        self.yaw_setpoint = np.zeros(drones)
        self.goal = np.zeros((drones, 3))
        self.decision = np.zeros(drones, np.int64)
        self.path = np.zeros((drones, steps + 1, 7))
        self.end_step, self.contact = np.zeros(drones, np.int64), np.zeros(drones)
        self.frames = frame_steps(config)
        pixels = config.camera.height * config.camera.width
        block = min(CAMERAS[camera].block, drones)
        self.camera = CAMERAS[camera](config.camera, self.world, block)
        self.poses = np.zeros((2, block, 7))
        self.luma = np.zeros((2, block, pixels))
        self.counts = record.events.reshape(drones, pixels)
        self.label = record.nearness.reshape(drones, pixels) if needs_nearness(config.encoder) else None

    def begin(self, drone: int, mission: int | None = None) -> None:
        """Puts a drone at rest at the start of a mission, facing its goal; draws the mission if None."""
        if mission is None:
            mission = int(self.random.integers(len(self.course.start)))
        start, goal = self.course.start[mission], self.course.goal[mission]
        yaw = math.atan2(goal[1] - start[1], goal[0] - start[0])
        self.state[drone] = 0.0
        self.state[drone, :3] = start
        self.state[drone, 3], self.state[drone, 6] = math.cos(yaw / 2), math.sin(yaw / 2)
        self.yaw_setpoint[drone] = yaw
        self.goal[drone] = goal
        self.decision[drone] = 0

    def reset(self, missions: Sequence[int] | None = None) -> None:
        """Starts the given or drawn mission for every drone, without events, because the drones are at rest."""
        for drone in range(len(self.goal)):
            self.begin(drone, None if missions is None else missions[drone])
        self.record.events[:], self.record.motion[:] = 0, 0.0
        self.write_own_states()

    def step(self, restart: bool = True) -> None:
        """Simulates one decision of every drone.

        Args:
            restart: whether drones whose episode ended start a new mission.
        """
        record, engine, geoms = self.record, self.engine, self.world.geoms
        with self.stopwatch.time("physics"):
            flight.fly(
                engine.model._address, engine.data._address, engine.data.qpos, engine.data.qvel, engine.data.ctrl,
                self.airframe, self.command, record.action, self.goal, self.state, self.yaw_setpoint, self.path,
            )  # fmt: skip
        with self.stopwatch.time("outcome"):
            task.judge(
                geoms, self.rules, self.goal, self.path, self.state, self.decision, record.outcome, record.reward,
                self.end_step, self.contact,
            )  # fmt: skip
            self._write_own_states(record.final_own)
            task.own_motion(ACTIONS, record.action, record.final_own, self.state, record.motion)
        block = self.poses.shape[1]
        for first in range(0, len(self.goal), block):
            self._render(slice(first, min(first + block, len(self.goal))))
        with self.stopwatch.time("outcome"):
            if restart:
                for drone in np.flatnonzero(record.outcome):
                    self.begin(int(drone))
            self.write_own_states()

    def write_own_states(self) -> None:
        """Writes the present own states into `record.own`."""
        self._write_own_states(self.record.own)

    def _write_own_states(self, own: NDArray[np.float32]) -> None:
        task.own_state(self.world.geoms, self.rules, self.goal, self.state, own)

    def _render(self, drones: slice) -> None:
        """Computes the events of some drones, and the label of the newest frame."""
        count = drones.stop - drones.start
        poses, luma = self.poses[:, :count], self.luma[:, :count]
        for at, frame in enumerate(self.frames):
            poses[at] = self.path[drones, frame]
        self.camera.draw(self.stopwatch, poses, luma, None if self.label is None else self.label[drones])
        with self.stopwatch.time("events"):
            events.signed_counts(self.law, luma[0], luma[1], self.counts[drones])
