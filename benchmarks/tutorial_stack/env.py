"""A Gymnasium environment of one drone in an MJCF world: C MuJoCo flies, MuJoCo's renderer sees, NumPy makes events."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from edqn_jax.config import CameraConfig, Config, EventsConfig
from edqn_jax.extras import require_extra
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.camera.camera import LUMA_WEIGHTS
from edqn_jax.sim.physics.airframe import SKYDIO_X2, mixer_of
from edqn_jax.sim.sensors.events import max_events
from tutorial_stack.control import thrusts

gymnasium = require_extra("gymnasium")

Picture = NDArray[np.uint8]
Look = Callable[[mujoco.MjData], Picture]
"""Returns the RGB picture [H, W, 3] of the drone's camera."""

OWN_SIZE = 10

LARGEST = 100.0
"""Bound of each number of an observation; what is flown stays far within."""


def world_with_drone(world: Path, config: Config) -> mujoco.MjModel:
    """Returns the world of an MJCF file with the airframe in it: a sphere that collides, and a camera, on its body."""
    spec = mujoco.MjSpec.from_file(str(world))
    drone = mujoco.MjSpec.from_file(str(SKYDIO_X2))
    body = drone.body("x2")
    for shape in list(drone.geoms):
        drone.delete(shape)
    radius = config.drone.body_radius_m
    sphere = body.add_geom(name="sphere", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], mass=0, group=5)
    sphere.contype, sphere.conaffinity = 1, 1
    half = math.tan(math.radians(config.camera.horizontal_fov_deg) / 2) * config.camera.height / config.camera.width
    # MuJoCo's cameras look along -z with y up, the drone along x with z up.
    body.add_camera(name="eye", fovy=math.degrees(2 * math.atan(half)), xyaxes=[0, -1, 0, 0, 0, 1])
    for each in (spec, drone):
        each.option.timestep = config.drone.physics_dt_s
    spec.attach(drone, frame=spec.worldbody.add_frame(), prefix="drone_")
    return spec.compile()


def renderer(model: mujoco.MjModel, config: CameraConfig) -> Look:
    """Returns MuJoCo's renderer of the drone's camera, without shadows and reflections, which take longest."""
    drawn = mujoco.Renderer(model, config.height, config.width)
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        drawn.scene.flags[flag] = 0

    def look(data: mujoco.MjData) -> Picture:
        drawn.update_scene(data, camera="drone_eye")
        return drawn.render()

    return look


def event_image(config: EventsConfig, before: Picture, after: Picture) -> NDArray[np.float32]:
    """Returns signed log(1 + count) [H, W] of the events between two pictures, by the paper's law (Eq. 1-4)."""
    first, second = config.frame_times_s
    weights = np.array(LUMA_WEIGHTS) / 255.0
    change = np.log(after @ weights + config.log_epsilon) - np.log(before @ weights + config.log_epsilon)
    counts = np.minimum(np.floor(np.abs(change) / config.tolerance), max_events(config, second - first))
    counts[np.abs(change) <= config.threshold] = 0
    return (np.sign(change) * np.log1p(counts)).astype(np.float32)


class TutorialDrone(gymnasium.Env):
    """Flies from the site `start` to the site `goal` of an MJCF file by 27 moves.

    Observes the event image [H x W] and ten own values, as one vector. A decision, its outcomes and its rewards are
    those of `edqn_jax`, but for a camera that tilts with the body.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(
        self, world: Path, config: Config, look: Callable[[mujoco.MjModel, CameraConfig], Look] = renderer
    ) -> None:
        """Compiles the world; `look` makes the camera."""
        self.config = config
        self.model = world_with_drone(world, config)
        self.data = mujoco.MjData(self.model)
        self.look = look(self.model, config.camera)
        airframe = mujoco.MjModel.from_xml_path(str(SKYDIO_X2))
        self.mass, self.inertia = float(airframe.body_mass[1]), airframe.body_inertia[1].copy()
        self.mixer, self.most = mixer_of(airframe), float(airframe.actuator_ctrlrange[0, 1])
        mujoco.mj_forward(self.model, self.data)
        sites = {name: self.data.site(name).xpos.copy() for name in ("start", "goal", "volume")}
        self.start, self.goal = sites["start"], sites["goal"]
        half = self.model.site("volume").size
        self.lower, self.upper = sites["volume"] - half, sites["volume"] + half
        steps, dt = config.drone.physics_steps, config.drone.physics_dt_s
        self.frames = [steps + round(time / dt) for time in config.events.frame_times_s]
        self.decisions, self.yaw = 0, 0.0
        pixels = config.camera.height * config.camera.width
        self.observation_space = gymnasium.spaces.Box(-LARGEST, LARGEST, (pixels + OWN_SIZE,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(len(ACTIONS))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begins at the start, at rest, facing the goal."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.decisions = 0
        self.yaw = math.atan2(*(self.goal - self.start)[1::-1])
        self.data.qpos[:] = [*self.start, math.cos(self.yaw / 2), 0.0, 0.0, math.sin(self.yaw / 2)]
        mujoco.mj_forward(self.model, self.data)
        picture = self.look(self.data)
        return self._make_observation(event_image(self.config.events, picture, picture)), {}

    def step(self, action: int) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Flies one decision."""
        task, data = self.config.env, self.data
        w, _, _, z = data.qpos[3:]
        heading = 2 * math.atan2(z, w)
        ahead, left, up = ACTIONS[action] * task.speed_m_s
        cos, sin = math.cos(heading), math.sin(heading)
        command = np.array([cos * ahead - sin * left, sin * ahead + cos * left, up])
        east, north = (self.goal - data.qpos[:3])[:2]
        near = math.hypot(east, north) < task.heading_hold_m
        bearing = self.yaw if near else math.atan2(north, east)
        before = np.linalg.norm(self.goal - data.qpos[:3])
        came_from, outcome, pictures = data.qpos[:3].copy(), "", []
        for number in range(1, self.config.drone.physics_steps + 1):
            self._turn(bearing)
            data.ctrl[:] = thrusts(
                *(self.config.drone, self.mass, self.inertia, self.mixer, self.most, -self.model.opt.gravity[2]),
                *(data.qpos, data.qvel, command, self.yaw),
            )
            mujoco.mj_step(self.model, data)
            if number in self.frames:
                pictures.append(self.look(data))
            outcome = outcome or self._outcome()
        self.decisions += 1
        gained = before - np.linalg.norm(self.goal - data.qpos[:3])
        reward = task.step_reward + task.progress_weight * gained
        reward -= task.path_weight * np.linalg.norm(data.qpos[:3] - came_from)
        ends = {"goal": task.goal_reward, "collision": task.collision_reward, "left_volume": task.left_volume_reward}
        reward += ends.get(outcome, 0.0)
        out_of_time = not outcome and self.decisions >= task.max_decisions
        observation = self._make_observation(event_image(self.config.events, *pictures))
        return observation, float(reward), bool(outcome), out_of_time, {"outcome": outcome}

    def _turn(self, bearing: float) -> None:
        """Moves the heading setpoint towards a bearing, radians, for one physics step."""
        missing = math.remainder(bearing - self.yaw, 2 * math.pi)
        most = self.config.drone.max_yaw_rate_rad_s * self.config.drone.physics_dt_s
        self.yaw += min(max(missing, -most), most)

    def _outcome(self) -> str:
        """Returns what has happened by now; nothing while the drone flies."""
        position = self.data.qpos[:3]
        if np.linalg.norm(self.goal - position) <= self.config.env.goal_radius_m:
            return "goal"
        if self.data.ncon > 0:
            return "collision"
        if np.any(position < self.lower) or np.any(position > self.upper):
            return "left_volume"
        return ""

    def _make_observation(self, events: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the event image and the ten own values of `edqn_jax.sim.task.observation.own_state` as one vector."""
        position, velocity = self.data.qpos[:3], self.data.qvel[:3] / self.config.env.speed_m_s
        w, x, y, z = self.data.qpos[3:]
        heading = 2 * math.atan2(z, w)
        cos, sin = math.cos(heading), math.sin(heading)
        way = self.goal - position
        own = [
            math.asinh(math.hypot(way[0], way[1]) / 2) / 2,
            math.asinh(way[2] / 2),
            *(cos, sin),
            *(2 * (position - self.lower) / (self.upper - self.lower) - 1),
            *(cos * velocity[0] + sin * velocity[1], cos * velocity[1] - sin * velocity[0], velocity[2]),
        ]
        return np.concatenate([events.ravel(), own]).astype(np.float32)
