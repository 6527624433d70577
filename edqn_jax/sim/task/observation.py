"""Observations: sensor output, own state and own motion; the poses at which a sensor samples."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from edqn_jax.config import Config, EnvConfig
from edqn_jax.errors import ConfigError
from edqn_jax.sim.physics import disturbances, drone
from edqn_jax.sim.physics.disturbances import Disturbance
from edqn_jax.sim.physics.drone import DroneState, Flight
from edqn_jax.sim.scene.scene import Scene, has_motion
from edqn_jax.sim.sensors import contrast, light, sensor
from edqn_jax.sim.sensors.sensor import Sensed, SensorMemory, attitudes_seen, count_attitudes, frame_steps, sensor_of

OWN_SIZE = 10
"""Values of the drone's own state in an observation, without what `own_size` adds."""

MOTION_SIZE = 7
"""Values of the drone's own motion in an observation, without what `motion_size` adds."""

MAX_YAW_RATE = 10.0
"""Bound of the yaw rate in an observation, rad/s."""

MIRRORED_MOTION = (1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0)
"""Factors [MOTION_SIZE] on the own motion when left and right are exchanged."""


@struct.dataclass
class Observation:
    """Observation of one drone: sensor output, by default the events before the decision, and own state."""

    sensed: Sensed
    own: Array  # [own_size], see `own_state` and `with_told`
    motion: Array  # [motion_size], see `own_motion`, `with_lean` and `with_told`; only the encoder sees it


@struct.dataclass
class View:
    """One moment of a flight, to be observed."""

    scene: Scene
    goal: Array  # [3] metres
    drone: DroneState
    move: Array  # [3] as in `own_motion`
    poses: Flight  # [T] at which the sensor looks, see `sensor_poses`
    disturbance: Disturbance | None = None  # whose errors own state and motion have; None where there are none


def knows_contrast(config: Config) -> bool:
    """Returns whether the networks know the contrast of the episode's event sensor, as one more value."""
    return contrast.is_drawn(config.events) and sensor_of(config).makes_events


def knows_light(config: Config) -> bool:
    """Returns whether the networks know the episode's illuminance, as one more value."""
    sensor = sensor_of(config)
    return config.light.told and (sensor.makes_events or (sensor.exposes and config.exposure.real))


def told_size(config: Config) -> int:
    """Returns the number of values that the networks are told of the episode's sensor."""
    return knows_light(config) + knows_contrast(config)


def leans(config: Config) -> bool:
    """Returns whether the camera leans with the body, so that the own motion has the body's roll and pitch."""
    return config.camera.mount == "body"


def own_size(config: Config) -> int:
    """Returns the number of values of the own state in an observation."""
    return OWN_SIZE + told_size(config)


def motion_size(config: Config) -> int:
    """Returns the number of values of the own motion in an observation."""
    return lean_motion_size(config) + told_size(config)


def lean_motion_size(config: Config) -> int:
    """Returns the number of values of `with_lean`."""
    return MOTION_SIZE + 2 * count_attitudes(config) * leans(config)


def mirrored_motion(config: Config) -> tuple[float, ...]:
    """Returns factors [motion_size] on the own motion when left and right are exchanged."""
    lean = (lean_motion_size(config) - MOTION_SIZE) // 2
    return (*MIRRORED_MOTION, *(-1.0, 1.0) * lean, *[1.0] * told_size(config))


def with_lean(config: Config, quaternions: Array, motion: Array) -> Array:
    """Returns own motions [..., MOTION_SIZE] with roll and pitch, radians, at each frame, if the camera leans.

    A body that turns between two frames moves the whole picture, so how it leant at each must be known.

    Args:
        config: of camera and sensor.
        quaternions: [..., T, 4] of `attitudes_seen`.
        motion: of `own_motion`.
    """
    if not leans(config):
        return motion
    angles = drone.roll_and_pitch_of(quaternions)
    return jnp.concatenate([motion, angles.reshape(*angles.shape[:-2], -1)], axis=-1)


def lean_of(config: Config, motion: Array) -> Array:
    """Returns roll and pitch [..., T, 2] in own motions [..., motion_size] of a camera that leans, see `with_lean`."""
    return motion[..., MOTION_SIZE : lean_motion_size(config)].reshape(*motion.shape[:-1], -1, 2)


def with_told(config: Config, memory: SensorMemory, values: Array) -> Array:
    """Returns own values [N] and after them those of the episode's light and contrast that the networks know.

    Raises:
        ConfigError: if the sensor's memory has not what it should tell.
    """
    if knows_light(config):
        values = jnp.concatenate([values, light.value_of(_held(config, memory, "lux"))[None]])
    if knows_contrast(config):
        values = jnp.concatenate([values, contrast.value_of(_held(config, memory, "contrast"))[None]])
    return values


def _held(config: Config, memory: SensorMemory, name: str) -> Array:
    """Returns what the sensor's memory has of its episode under this name [].

    Raises:
        ConfigError: if it has nothing.
    """
    value = getattr(memory, name, None)
    if value is None:
        raise ConfigError(
            f"the memory of the sensor '{config.env.sensor}' must have the episode's `{name}`, which the networks are "
            "told; `at_rest` returns the first one"
        )
    return value


def observe(config: Config, view: View, memory: SensorMemory, key: Array) -> tuple[Observation, SensorMemory]:
    """Returns sensor output, own state [own_size] and own motion [motion_size], and the sensor's memory.

    Args:
        config: of sensor and task.
        view: scene, goal and poses to observe.
        memory, key: as in `sensor.sense`.
    """
    state = view.drone
    if view.disturbance is not None and disturbances.has_noise(config.noise):
        key, errs = jax.random.split(key)
        position, velocity = disturbances.estimate_state(
            config.noise, view.disturbance, state.position, state.velocity, errs
        )
        state = dataclasses.replace(state, position=position, velocity=velocity)
    sensed, memory = sensor.sense(config, view.scene, view.poses, memory, key)
    own = with_told(config, memory, own_state(config.env, view.scene, view.goal, state))
    motion = with_lean(config, attitudes_seen(view.poses, memory), own_motion(config.env, state, view.move))
    motion = with_told(config, memory, motion)
    return Observation(sensed=sensed, own=own, motion=motion), memory


def own_state(config: EnvConfig, scene: Scene, goal: Array, state: DroneState) -> Array:
    """Returns the drone's own ten values [OWN_SIZE], each of order 1.

    Horizontal distance and height to the goal (asinh(d / 2 m) / 2 and asinh(h / 2 m): metres count near the
    goal, powers of ten far away), cosine and sine of the heading, own position scaled to [-1, 1] in the
    flight volume (3), own velocity in the heading frame (3, in commanded speeds).

    Without `config.position` the first value is of the metres ahead to the goal, the position's horizontal values are 0
    and its height gives way to the metres to the left, in the heading frame and scaled as the distance.
    """
    yaw = drone.yaw_of(state.quaternion)
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    way = goal - state.position
    if config.position:
        lower, upper = scene.volume[0], scene.volume[1]
        distance = jnp.sqrt(way[0] ** 2 + way[1] ** 2)
        place = 2 * (state.position - lower) / (upper - lower) - 1
    else:
        distance, left = cos * way[0] + sin * way[1], cos * way[1] - sin * way[0]
        place = jnp.stack([jnp.zeros(()), jnp.zeros(()), jnp.arcsinh(left / 2.0) / 2.0])
    towards = jnp.stack([jnp.arcsinh(distance / 2.0) / 2.0, jnp.arcsinh(way[2] / 2.0), cos, sin])
    return jnp.concatenate([towards, place, heading_velocity(config, yaw, state.velocity)])


def rotate_own_state(own: Array, quarters: Array) -> Array:
    """Returns own states [..., OWN_SIZE] as they would be with world and drone turned about the volume's middle.

    Args:
        own: in a volume that is as long as it is wide; what follows the first `OWN_SIZE` values does not turn.
        quarters: [...] int32, quarter turns to the left.
    """
    cos, sin = jnp.array([1.0, 0.0, -1.0, 0.0])[quarters], jnp.array([0.0, 1.0, 0.0, -1.0])[quarters]
    towards_x, towards_y = own[..., 2:6:2], own[..., 3:6:2]  # of the heading, and of the position in the volume
    x = cos[..., None] * towards_x - sin[..., None] * towards_y
    y = sin[..., None] * towards_x + cos[..., None] * towards_y
    pairs = jnp.stack([x, y], axis=-1).reshape(*x.shape[:-1], 4)
    return jnp.concatenate([own[..., :2], pairs, own[..., 6:]], axis=-1)


def own_motion(config: EnvConfig, state: DroneState, move: Array) -> Array:
    """Returns the own motion [MOTION_SIZE], each value of order 1.

    Velocity in the heading frame (3, in commanded speeds), yaw rate (rad/s, at most `MAX_YAW_RATE`), last move (3).

    Args:
        config: says what a commanded speed is.
        state: of the drone.
        move: [3] direction in the heading frame that was commanded at the last decision, see `ActionSet.direction`; of
            moves -1, 0 and 1, zeros at a start. With `env.action_delay` it is yet to be flown.
    """
    velocity = heading_velocity(config, drone.yaw_of(state.quaternion), state.velocity)
    # Of a drone on its back the heading turns at any rate.
    rate = jnp.clip(drone.yaw_rate_of(state), -MAX_YAW_RATE, MAX_YAW_RATE)
    return jnp.concatenate([velocity, rate[None], move])


def heading_velocity(config: EnvConfig, yaw: Array, velocity: Array) -> Array:
    """Returns velocities [..., 3] m/s in the frame of headings [...] radians, in commanded speeds."""
    vx, vy, vz = jnp.moveaxis(velocity / config.speed_m_s, -1, 0)
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([cos * vx + sin * vy, cos * vy - sin * vx, vz], axis=-1)


def poses_at_start(config: Config, scene: Scene, body: DroneState) -> Flight:
    """Returns the poses [T] at which the sensor looks before an episode, in which the body is at rest."""
    before = np.array(frame_steps(config)) - config.drone.physics_steps
    return with_times(config, repeat_pose(body, len(before)), jnp.asarray(before) if has_motion(scene) else None)


def repeat_pose(body: DroneState, n: int) -> Flight:
    """Returns n times the same pose."""
    repeat: Callable[[Array], Array] = lambda x: jnp.broadcast_to(x, (n, *x.shape))  # noqa: E731
    return Flight(position=repeat(body.position), quaternion=repeat(body.quaternion), velocity=repeat(body.velocity))


def with_times(config: Config, flight: Flight, steps: Array | None) -> Flight:
    """Returns a flight with the times of its poses, taken after physics steps `steps` [n] of the episode.

    In a static scene the times are None.
    """
    if steps is None:
        return flight
    return dataclasses.replace(flight, time=steps * config.drone.physics_dt_s)


def sensor_poses(config: Config, first: DroneState, flight: Flight) -> Flight:
    """Returns the sensor's poses [T], selected from the pose before the decision and those after each physics step."""
    began = None if flight.time is None else flight.time[0] - config.drone.physics_dt_s
    path = jax.tree.map(
        lambda a, b: jnp.concatenate([a[None], b]),
        Flight(position=first.position, quaternion=first.quaternion, velocity=first.velocity, time=began),
        flight,
    )
    return jax.tree.map(lambda x: jnp.stack([x[i] for i in frame_steps(config)]), path)
