"""An environment for people: made from the name of a world; reset, step and see as pure functions.

environment = make("medium")
state, observation = environment.reset()
state, step = environment.step(state, "ahead")
environment.events(step.observation)
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from edqn_jax.config import FAMILIES, SENSORS, Config
from edqn_jax.config.loading import check_config, make_config
from edqn_jax.devices.forks import check_not_forked
from edqn_jax.devices.jax_settings import as_tested
from edqn_jax.devices.sums import check_default_sums
from edqn_jax.errors import ConfigError
from edqn_jax.sim.camera import camera
from edqn_jax.sim.camera.painting import materials
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.mjcf import check_scene, load_world, mjcf_of, resolve_world
from edqn_jax.sim.scene.motion import Aim
from edqn_jax.sim.scene.scene import Scene, scene_at
from edqn_jax.sim.sensors import event_field, event_laws, sensor
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.sensors.event_memory import EventMemory
from edqn_jax.sim.task import env, group
from edqn_jax.sim.task.action_sets import action_of
from edqn_jax.sim.task.env import EnvParams, EnvState, Step
from edqn_jax.sim.task.missions import own_missions
from edqn_jax.sim.task.observation import Observation
from edqn_jax.sim.task.reward import Reward, check_reward
from edqn_jax.sim.task.task import task_of
from edqn_jax.sim.worlds.families import SPLITS, Split, world_of_file, worlds_of
from edqn_jax.watchers import shown_phases


@dataclasses.dataclass(frozen=True, eq=False)
class Environment:
    """One or more worlds, a mission in each, and the functions of one drone in them.

    `reset`, `step`, `picture` and `depth` are compiled when first called, and may be called within `jax.jit` and
    `jax.vmap`.
    """

    config: Config
    world: EnvParams

    @property
    def missions(self) -> int:
        """Returns the number of missions."""
        return self.world.missions.scene.shape[0]

    @as_tested
    def scene(self, mission: int = 0) -> Scene:
        """Returns the world of a mission: its shapes, flight volume, start and goal."""
        return env.scene_of(self.world, jnp.asarray(mission))

    @as_tested
    def mjcf(self, mission: int = 0) -> str:
        """Returns the world of a mission as the text of an MJCF file, which MuJoCo and `make` open."""
        return mjcf_of(self.scene(mission), title=f"{self.config.world.name} {mission}")

    @as_tested
    def write_painted(self, file: str | Path, mission: int = 0) -> None:
        """Writes the world of a mission as an MJCF file NAME.xml with textures, PNGs in NAME_textures beside it.

        MuJoCo shows the patterns and the light there that the drone's camera sees. The file names others, so that
        `make` does not read it; it reads `mjcf`, which has the same looks as numbers.

        Raises:
            ConfigError: if a file cannot be written.
        """
        title = f"{self.config.world.name} {mission}"
        materials.write_painted(self.config.camera, self.scene(mission), Path(file), title=title)

    @as_tested
    def reset(self, key: int | Array = 0, mission: int | Array | None = None) -> tuple[EnvState, Observation]:
        """Returns the state at the start of a mission, at rest and facing the goal, and what is observed there.

        Args:
            key: a typed JAX key, consumed, or a seed.
            mission: [] int, which one; None draws one.
        """
        check_not_forked()
        key = jax.random.key(key) if isinstance(key, int) else key
        return _reset(self.config, self.world, key, None if mission is None else jnp.asarray(mission, jnp.int32))

    @as_tested
    def step(self, state: EnvState, action: str | ArrayLike) -> tuple[EnvState, Step]:
        """Flies one decision (0.26 s), or resets to a drawn mission where the episode has ended.

        Args:
            state: as `reset` or `step` returned it.
            action: a move: number 0..26, vector [3] of -1, 0 and 1 (ahead, left, up in the heading frame), or name such
                as `ahead`, `left up` or `hover`. With another `env.actions` its numbers, such as [3] in [-1, 1], beyond
                which they are clipped.

        Raises:
            ConfigError: if there is no such action.
        """
        check_not_forked()
        return _step(self.config, self.world, state, action_of(self.config, action))

    @as_tested
    def events(self, observation: Observation) -> np.ndarray:
        """Returns the events of one drone's observation, sorted by time.

        A structured array [N]: `t` int64 microseconds from the window's start, `x` and `y` uint16 pixels, `p` int8
        polarity, -1 or 1.

        Raises:
            ConfigError: if the sensor is not the event camera.
        """
        return event_field.to_stream(self._field(observation))

    @as_tested
    def event_image(self, observation: Observation) -> np.ndarray:
        """Returns the signed number of events of each pixel, [H, W] int32.

        Raises:
            ConfigError: if the sensor is not the event camera.
        """
        return np.asarray(event_field.event_image(self._field(observation)))

    @as_tested
    def stream(
        self,
        flight: Flight,
        mission: int = 0,
        law: Literal["paper", "airsim", "esim"] = "esim",
        aim: Aim | None = None,
    ) -> np.ndarray:
        """Returns the events of a camera that watches a whole flight, with a frame at every physics step.

        Args:
            flight: poses [T] of consecutive physics steps, such as the `flight` of steps, concatenated. Where shapes
                move, each sees them at its own `time`.
            mission: in whose world it was flown.
            law: of the events; `esim` remembers each pixel's level from frame to frame.
            aim: `EnvState.aim` at the end of the flight: where the balls of a world with some were thrown. None throws
                them at a drone of steady pace.

        The camera's faults, and its light where there is any, are drawn, and are the same at every call.

        Returns:
            a structured array as `events` returns it; `t` counts from the first pose.
        """
        sees = dataclasses.replace(self.config, events=dataclasses.replace(self.config.events, law=law))
        scene = env.scene_of(self.world, jnp.asarray(mission), aim)
        return event_field.to_stream(_stream(sees, scene, flight))

    @as_tested
    def picture(self, state: EnvState, scale: int = 8) -> Array:
        """Returns what a person would see from the drone's camera: [H * scale, W * scale, 3] sRGB in [0, 1]."""
        scene = env.scene_now(self.config, self.world, state)
        body = state.drone
        return _picture(self.config, scale, scene, body.position, body.quaternion)

    @as_tested
    def depth(self, state: EnvState) -> Array:
        """Returns the true distance along each pixel's ray [H, W] metres, inf where it meets nothing: a label."""
        scene = env.scene_now(self.config, self.world, state)
        return _depth(self.config, scene, state.drone.position, state.drone.quaternion)

    def _field(self, observation: Observation) -> EventField:
        if not isinstance(observation.sensed, EventField):
            raise ConfigError(f"the sensor '{self.config.env.sensor}' makes no events; env.sensor must be 'events'")
        return observation.sensed


@as_tested
def make(
    world: str | Path | None = None,
    config: Config | None = None,
    *,
    worlds: int = 1,
    seed: int = 0,
    split: Split = "training",
    reward: Reward | None = None,
) -> Environment:
    """Makes an environment.

    Args:
        world: `paper`, the name of random worlds (`config.FAMILIES`), or an MJCF file; None takes that of
            `config`.
        config: of drone, camera, events and task; without it the default for that world.
        worlds: how many random worlds, each with a mission of its own; 1 for a world from a file.
        seed: which random worlds of the split.
        split: of random worlds: `training`, which training draws from, `validation`, or `test`, whose first worlds are
            those of `evaluate`.
        reward: of every decision, in place of the configured one: a function of a `Transition`.

    Raises:
        ConfigError: if there is no such world, the drone does not fit at its start or goal, several drones are
            configured, or the process was forked after JAX had been used.

    Warns:
        RuntimeWarning: if XLA computes wrong sums on this CPU in programs that are compiled with its defaults.
    """
    check_not_forked()
    check_default_sums()
    check_config(config)
    check_reward(reward)
    name = str(world) if world is not None else (config or Config()).world.name
    config = make_config(name) if config is None else config
    group.check_alone(config, "edqn_jax.make")
    with shown_phases(None) as told:  # the first time, programs are compiled for some seconds
        if told is not None:
            told("preparing worlds")
        pool = _random_pool(config, name, worlds, seed, split) if name in FAMILIES else _file_pool(config, name, worlds)
    return Environment(config, EnvParams(load_airframe(config.drone), pool, own_missions(pool), reward))


def _random_pool(config: Config, name: str, count: int, seed: int, split: Split) -> Scene:
    if split not in SPLITS:
        raise ConfigError(f"split must be one of {', '.join(SPLITS)}, not '{split}'")
    if count < 1 or seed < 0:
        raise ConfigError(f"worlds must be at least 1 and seed at least 0, not {count} and {seed}")
    return worlds_of(config, name, split, count, first=seed * count)


def _file_pool(config: Config, name: str, count: int) -> Scene:
    if count != 1:
        raise ConfigError(f"worlds must be 1 for '{name}', which is one world, not {count}")
    loaded = load_world(resolve_world(name))
    check_scene(loaded.scene, config.drone.body_radius_m, names=loaded.names, title=f"'{name}'")
    return world_of_file(config, loaded.scene)


@functools.partial(jax.jit, static_argnums=0)
def _reset(config: Config, env_params: EnvParams, key: Array, mission: Array | None) -> tuple[EnvState, Observation]:
    return task_of(config).reset(env_params, key, mission)


@functools.partial(jax.jit, static_argnums=0)
def _step(config: Config, env_params: EnvParams, state: EnvState, action: Array) -> tuple[EnvState, Step]:
    return task_of(config).step(env_params, state, action)


@functools.partial(jax.jit, static_argnums=0)
def _stream(config: Config, scene: Scene, flight: Flight) -> EventField:
    def see(pose: Flight) -> Array:
        return sensor.render_view(config, scene_at(scene, pose.time), pose.position, pose.quaternion)

    frames = jax.lax.map(see, flight)
    times = tuple(config.drone.physics_dt_s * np.arange(frames.shape[0]))
    key, noise = jax.random.split(jax.random.key(0))
    memory = SENSORS.get("events").at_rest(config, key)
    assert isinstance(memory, EventMemory)
    return event_laws.generate_events(config.events, memory, frames, times, noise, continuous=True)[0]


@functools.partial(jax.jit, static_argnums=0)
def _depth(config: Config, scene: Scene, position: Array, quaternion: Array) -> Array:
    return camera.render_depth(config.camera, scene, position, sensor.mount_rotation(config, quaternion))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _picture(config: Config, scale: int, scene: Scene, position: Array, quaternion: Array) -> Array:
    rotation = sensor.mount_rotation(config, quaternion)
    return camera.on_screen(camera.fine_rgb(config.camera, scale, scene, position, rotation))
