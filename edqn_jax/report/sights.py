"""Images at poses of a flight: RGB for people, the sensor's image, and the VAE's reconstruction."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from concurrent.futures import Executor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array
from jax.stages import Compiled

from edqn_jax.config import Config
from edqn_jax.devices.devices import quick_compiler_options
from edqn_jax.evaluation.decoder import metres_of, predicted_distance
from edqn_jax.evaluation.trajectories import ATTITUDE, POSITION, VELOCITY, actions_of, columns_of, directions
from edqn_jax.kept_programs import kept_jit, named, place_of, without_seed
from edqn_jax.learn.actor import AgentActor, PolicyParams
from edqn_jax.learn.perception import embedding, vae
from edqn_jax.learn.policy import fresh_policy
from edqn_jax.sim.camera import camera
from edqn_jax.sim.physics import drone
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.scene import Scene, scene_at
from edqn_jax.sim.sensors import sensor
from edqn_jax.sim.task.observation import (
    MOTION_SIZE,
    Observation,
    heading_velocity,
    own_size,
    repeat_pose,
    with_lean,
    with_told,
)

FINE = 8
"""How much finer than the drone's camera the RGB pictures for people are, per axis."""


@dataclasses.dataclass(frozen=True)
class SensorImages:
    """The sensor's images at D decisions, with the VAE's targets and reconstructions."""

    image: np.ndarray
    """[D, H, W] ON minus OFF events per pixel, or the first picture."""
    luma: np.ndarray
    """[D, H, W] linear brightness in the drone's camera at the end of each decision."""
    target: np.ndarray | None = None
    """[D, H, W] what the decoder must draw, blurred: nearness, ON plus OFF events per pixel, or the first picture; None
    where there is no decoder."""
    reconstruction: np.ndarray | None = None
    """[D, H, W] what it draws from the code, in the same units."""
    distance: np.ndarray | None = None
    """[D, H, W] true distance along each pixel's ray, metres, infinity where there is nothing; None where the decoder
    does not predict it."""
    predicted: np.ndarray | None = None
    """[D, H, W] the distance that it predicts."""


_Images = tuple[Array, ...]
"""As the fields of `SensorImages`, without those at the end that are None."""


class FlightRenderer:
    """Programs that draw images in one world; compiled in the background, since that takes seconds."""

    def __init__(self, config: Config, scene: Scene, pool: Executor, *, decodes: bool = True) -> None:
        """Compiles in `pool`; `shown` and `rgb` wait for it.

        Args:
            config: of the policy that flies.
            scene: one world.
            pool: with two threads, both programs are compiled at once.
            decodes: whether the policy has a decoder, which a function has not.
        """
        self.config, self.scene, self._decodes = config, scene, decodes
        drawable = sensor.sensor_of(config).image is not None
        self.has_image = drawable and (embedding.has_code(config) or not decodes)
        """Whether the sensor shows an image, of a policy one that is encoded; without one there is only `rgb`."""
        self._shown = pool.submit(self._compile_shown) if self.has_image else None
        self._rgb = pool.submit(self._compile_rgb)

    def in_world(self, scene: Scene) -> FlightRenderer:
        """Returns the same programs for another world whose arrays have the same shapes."""
        other = copy.copy(self)
        other.scene = scene
        return other

    def shown(self, params: PolicyParams | None, trajectory: Mapping[str, np.ndarray]) -> SensorImages:
        """Returns the sensor's images at each decision of a flight, and their reconstructions.

        Args:
            params: whose VAE; None without a decoder.
            trajectory: the columns of `trajectory.csv`, as `decision_rows`.
        """
        assert self._shown is not None, "this sensor shows no image"
        rows = decision_rows(self.config, trajectory)
        padded = np.pad(rows, ((0, self.config.env.max_decisions - len(rows)), (0, 0)), mode="edge")
        motions = own_motions(self.config, trajectory, padded)
        seen = (*trajectory_poses(trajectory, padded), times_of(trajectory, padded))
        seen = [np.concatenate(pair) for pair in zip(start_poses(self.config, trajectory), seen, strict=True)]
        found = self._shown.result()(self.scene, params, *seen, np.concatenate([motions[:1], motions]))
        return SensorImages(*(np.asarray(leaf)[1 : len(rows) + 1] for leaf in found))

    def rgb(self, position: np.ndarray, quaternion: np.ndarray, time: npt.ArrayLike = 0.0) -> np.ndarray:
        """Returns the linear RGB [FINE H, FINE W, 3] of the drone's camera at a pose and a time, a ray per pixel."""
        return np.asarray(self._rgb.result()(self.scene, position, quaternion, np.asarray(time, np.float32)))

    def _compile_shown(self) -> Compiled:
        config, observations = self.config, 1 + self.config.env.max_decisions
        looks = len(sensor.frame_steps(config))
        params = jax.eval_shape(lambda: fresh_policy(config)) if self._decodes else None
        motion = jax.ShapeDtypeStruct((observations, MOTION_SIZE), np.float32)
        return self._compiled("sights", self._all_shown, self.scene, params, *_blank_poses(observations, looks), motion)

    def _all_shown(
        self, scene: Scene, params: PolicyParams | None, position: Array, quaternion: Array, time: Array, motion: Array
    ) -> _Images:
        """The images of `shown` at the start and D decisions, [1 + D, T, ...] poses and times, with own motions.

        The sensor carries its memory from each observation to the next, as in flight.
        """
        config, actor, shows = self.config, AgentActor(self.config), sensor.sensor_of(self.config)
        start, rest = jax.random.split(jax.random.key(0))

        def one(memory: Any, given: tuple[Array, ...]) -> tuple[Any, _Images]:
            position, quaternion, time, motion, key = given
            here = Flight(position, quaternion, jnp.zeros_like(position), time)
            now = scene_at(scene, time[-1])
            sensed, memory = sensor.sense(config, scene, here, memory, key)
            image, luma = shows.picture(config, sensed), sensor.render_view(config, now, position[-1], quaternion[-1])
            if params is None:
                return memory, (image, luma)
            nearness = None
            if embedding.needs_nearness(config):
                nearness = sensor.label_image(config, now, position[-1], quaternion[-1])
            # The goal is not part of a code.
            motion = with_told(config, memory, with_lean(config, sensor.attitudes_seen(here, memory), motion))
            observation = Observation(sensed, own=jnp.zeros(own_size(config)), motion=motion)
            code = actor.code(actor.encode(params, actor.init(), observation))
            read = embedding.as_encoder_input(config, observation).sensed
            assert read is not None
            target = vae.decoder_target(config.encoder, read, nearness)
            made = vae.decode(config.encoder, config.camera, params.encoder, code)
            pictures = (_as_picture(config, channels) for channels in (target, made))
            if nearness is None:
                return memory, (image, luma, *pictures)
            predicted = predicted_distance(config, params.encoder, code)
            return memory, (image, luma, *pictures, metres_of(nearness), predicted)

        keys = jax.random.split(rest, len(position))
        before = sensor.at_rest(config, start)
        return jax.lax.scan(one, before, (position, quaternion, time, motion, keys))[1]

    def _compile_rgb(self) -> Compiled:
        def picture(scene: Scene, position: Array, quaternion: Array, time: Array) -> Array:
            rotation = sensor.mount_rotation(self.config, quaternion)
            return camera.fine_rgb(self.config.camera, FINE, scene_at(scene, time), position, rotation)

        return self._compiled("rgb", picture, self.scene, *_blank_poses())

    def _compiled(self, name: str, program: Any, *arguments: Any) -> Compiled:
        place = place_of(name, (without_seed(self.config), self._decodes), arguments)
        function, options = jax.jit(named(program, place.name)), quick_compiler_options(jax.default_backend())
        return place.load_or_compile(lambda: [function.lower(*arguments)], jax.local_devices()[:1], options)[0]


def decision_rows(config: Config, trajectory: Mapping[str, np.ndarray]) -> np.ndarray:
    """Returns the rows [D, T] of a trajectory at which the sensor looks, T of them for each whole decision.

    Args:
        trajectory: the columns of `trajectory.csv`, each [rows]; row k stands after physics step k + 1.
    """
    n, steps = config.drone.physics_steps, len(trajectory["t"])
    decisions = np.arange(max(steps // n, 1))[:, None]
    return np.clip(decisions * n + np.array(sensor.frame_steps(config)) - 1, 0, steps - 1)


def start_poses(config: Config, trajectory: Mapping[str, np.ndarray]) -> tuple[np.ndarray, ...]:
    """Returns positions [1, T, 3], attitudes [1, T, 4] and times [1, T] at which the sensor looks before a flight.

    The drone is at rest. A trajectory begins after the first physics step, which moved it with the velocity at its end.
    """
    dt, first = config.drone.physics_dt_s, np.zeros(1, int)
    steps = np.array(sensor.frame_steps(config)) - config.drone.physics_steps
    (moved,), (quaternion,) = trajectory_poses(trajectory, first)
    start = moved - np.float32(dt) * columns_of(trajectory, VELOCITY)[0].astype(np.float32)
    here = _at_rest(start, quaternion, len(steps))
    times = np.asarray(trajectory["t"])[0] + dt * (steps - 1.0)
    return tuple(np.asarray(leaf, np.float32)[None] for leaf in (here.position, here.quaternion, times))


@kept_jit(2)
def _at_rest(position: Array, quaternion: Array, count: int) -> Flight:
    """Returns `count` times the pose of a drone at rest at `position` [3], with the heading of `quaternion` [4]."""
    return repeat_pose(drone.hover_state(position, drone.yaw_of(quaternion)), count)


def trajectory_poses(trajectory: Mapping[str, np.ndarray], rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions [..., 3] in metres and attitudes [..., 4] of a trajectory at rows [...]."""
    position, quaternion = (columns_of(trajectory, names)[rows] for names in (POSITION, ATTITUDE))
    return position.astype(np.float32), quaternion.astype(np.float32)


def times_of(trajectory: Mapping[str, np.ndarray], rows: np.ndarray) -> np.ndarray:
    """Returns the times [...] of a trajectory at rows [...], seconds."""
    return np.asarray(trajectory["t"])[rows].astype(np.float32)


def downsample_picture(picture: np.ndarray) -> np.ndarray:
    """Returns a linear RGB picture [..., FINE H, FINE W, 3] at the drone's resolution, [..., H, W, 3]."""
    *many, height, width, channels = picture.shape
    blocks = picture.reshape(*many, height // FINE, FINE, width // FINE, FINE, channels)
    return blocks.mean(axis=(-4, -2))


def own_motions(config: Config, trajectory: Mapping[str, np.ndarray], rows: np.ndarray) -> np.ndarray:
    """Returns the own motions [D, MOTION_SIZE] at the last of each decision's rows [D, T].

    The yaw rate is that of the heading between the last two rows, which a trajectory holds.
    """
    last = rows[:, -1]
    (place, now), (_, before) = (
        trajectory_poses(trajectory, last),
        trajectory_poses(trajectory, np.maximum(last - 1, 0)),
    )
    velocity = columns_of(trajectory, VELOCITY)[last].astype(np.float32)
    actions = np.asarray(actions_of(trajectory)[last], np.float32)
    return np.asarray(_motions(without_seed(config), place, now, before, velocity, actions), np.float32)


@kept_jit(0)
def _motions(config: Config, place: Array, now: Array, before: Array, velocity: Array, actions: Array) -> Array:
    """Returns own motions [D, MOTION_SIZE] of poses, attitudes now and a physics step before, velocities, actions."""
    yaw = drone.yaw_of(now)
    rate = drone.wrap_angle(yaw - drone.yaw_of(before)) / config.drone.physics_dt_s
    ahead = heading_velocity(config.env, yaw, velocity)
    commanded = directions(config, Flight(place, now, velocity), actions)
    return jnp.concatenate([ahead, rate[:, None], commanded], axis=-1)


def _blank_poses(*shape: int) -> tuple[jax.ShapeDtypeStruct, ...]:
    """Returns positions, quaternions and times of poses [...], without values."""
    return tuple(jax.ShapeDtypeStruct((*shape, *size), np.float32) for size in ((3,), (4,), ()))


def _as_picture(config: Config, channels: Array) -> Array:
    """Returns the channel to display, [H, W] in its units, of a target [C, H, W] of `vae.decoder_target`."""
    if embedding.needs_nearness(config):
        return channels[-1]
    return sensor.sensor_of(config).picture_of_target(config, channels)
