"""Sensors: what a drone sees of the world around it. `SENSORS` has one entry for each choice of `env.sensor`.

A new sensor is an entry here and a choice in `config/options.py`; all other code asks the entry.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import CameraConfig, Config
from edqn_jax.sim.actions import DIRECTIONS
from edqn_jax.sim.camera import camera, raycast
from edqn_jax.sim.camera.depth import nearest_depth
from edqn_jax.sim.camera.raycast import Rays
from edqn_jax.sim.physics import drone
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.scene import Scene, scene_at
from edqn_jax.sim.sensors import events, exposure, light
from edqn_jax.sim.sensors.events import EventField, EventMemory
from edqn_jax.sim.sensors.exposure import FrameMemory

Sensed = EventField | Array | None
"""What a sensor shows, see `Form`."""

SensorMemory = EventMemory | FrameMemory | None
"""What a sensor carries from one decision to the next."""

MID_GREY = -1.0
"""Log brightness that `frames` shows as 0: about the middle of the range in a scene."""

HALF_NEAR_M = 4.0
"""Distance at which nearness is one half, metres: what a drone flies along an axis in a second."""

DEPTH_SCALE = 3.0
"""Value of `depth` at contact: its pictures then vary as much as frames do, and the VAE weighs both alike."""


CHANGE_SCALE = 0.1
"""Change of log brightness that `frame-pair` shows as 1: that of two or three events."""

CLOSING_SCALE = 0.5
"""Rate at which `depth-motion` shows obstacles come nearer, 1/s, per unit before it saturates: of `depth`'s own
values, 3 m/s at a distance of 4 m."""


class Form(enum.Enum):
    """Form of what a sensor shows. It decides how the observation is embedded and drawn."""

    EVENTS = enum.auto()
    """An event field at the camera's resolution; the VAE embeds it."""
    PICTURE = enum.auto()
    """Pictures of order 1 at the camera's resolution, an array [C, H, W]; the VAE embeds them."""
    VALUES = enum.auto()
    """An array [V] of order 1; the Q-network sees it as it is."""
    NOTHING = enum.auto()
    """None; the Q-network sees only the drone's own state."""


@dataclasses.dataclass(frozen=True)
class Image:
    """How a sensor's image is labelled and coloured in figures."""

    label: str
    unit: str
    signed: bool = False
    """Whether it holds signed event counts: the colours are symmetric about 0. Otherwise they span the values."""


def _now(config: Config) -> tuple[float, ...]:
    return (0.0,)


def _window(config: Config) -> tuple[float, ...]:
    return config.events.frame_times_s


def _no_values(config: Config) -> int:
    return 0


def _one(config: Config) -> int:
    return 1


def _no_memory(config: Config, key: Array) -> SensorMemory:
    return None


@dataclasses.dataclass(frozen=True)
class Sensor:
    """Everything that the rest of the code asks about one sensor. T frame times."""

    show: Callable[[Config, Scene, Flight, SensorMemory, Array], tuple[Sensed, SensorMemory]]
    """As `sense`."""
    form: Form
    values: Callable[[Config], int] = _no_values
    """V of `Form.VALUES`."""
    pictures: Callable[[Config], int] = _one
    """C of `Form.PICTURE`."""
    frame_times_s: Callable[[Config], tuple[float, ...]] = _now
    """Times of the T poses that `show` needs, seconds relative to the end of a decision; each is a physics step."""
    draws_frames: bool = False
    """Whether `show` draws a picture at each of these times."""
    exposes: bool = False
    """Whether its pictures are taken as `exposure` has it, over the poses up to a frame's time."""
    at_rest: Callable[[Config, Array], SensorMemory] = _no_memory
    """Memory before the first decision, from a key; None where nothing is carried from one decision to the next."""
    image: Image | None = None
    """How what is shown is drawn; None where it is no image."""

    def example(self, config: Config) -> Sensed:
        """Returns random data of the form that the sensor shows, the same at every call."""
        rng, shape = np.random.default_rng(0), (config.camera.height, config.camera.width)
        match self.form:
            case Form.NOTHING:
                return None
            case Form.VALUES:
                return jnp.asarray(rng.random(self.values(config), np.float32))
            case Form.PICTURE:
                return jnp.asarray(rng.random((self.pictures(config), *shape), np.float32))
            case Form.EVENTS:
                return events.random_field(config.events, *shape, rng)


def sensor_of(config: Config) -> Sensor:
    """Returns the entry of `SENSORS` that `config` names."""
    return SENSORS[config.env.sensor]


def frame_steps(config: Config) -> tuple[int, ...]:
    """Returns the physics steps of a decision, 0..n, after which the sensor needs a pose."""
    n = config.drone.physics_steps
    return tuple(n + round(t / config.drone.physics_dt_s) for t in sensor_of(config).frame_times_s(config))


def frames_per_decision(config: Config) -> int:
    """Returns the number of pictures that are drawn for one decision."""
    if not sensor_of(config).draws_frames:
        return 0
    if not (sensor_of(config).exposes and config.exposure.real):
        return len(frame_steps(config))
    poses = exposure.steps_touched(config.exposure, config.drone.physics_dt_s) + 1
    return len(frame_steps(config)) // poses * config.exposure.sub_frames


def view(config: Config, scene: Scene, position: Array, quaternion: Array) -> Array:
    """Returns the camera's luma frame [H, W] on a body at `position` [3], metres, with attitude `quaternion` [4]."""
    return camera.luma(config.camera, scene, position, mount_rotation(config, quaternion))


def mount_rotation(config: Config, quaternion: Array) -> Array:
    """Returns the camera's [3, 3] body-to-world rotation: the heading alone when level, else the full attitude."""
    if config.camera.mount == "level":
        w, z = quaternion[0], quaternion[3]
        scale = jax.lax.rsqrt(jnp.maximum(w * w + z * z, 1e-9))
        quaternion = jnp.stack([w * scale, jnp.zeros_like(w), jnp.zeros_like(w), z * scale])
    w, x, y, z = quaternion
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def at_rest(config: Config, key: Array) -> SensorMemory:
    """Returns the sensor's memory before the first decision; None where it has none."""
    return sensor_of(config).at_rest(config, key)


def sense(config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array) -> tuple[Sensed, SensorMemory]:
    """Returns what the sensor shows at the end of a decision, and its memory after it.

    Args:
        scene: one world; each pose sees it as it stands at the pose's time.
        poses: [T, ...] after the physics steps of `frame_steps`, in order.
        memory: from `at_rest` or the decision before.
        key: consumed only by noise.
    """
    return sensor_of(config).show(config, scene, poses, memory, key)


def _views(config: Config, scene: Scene, poses: Flight) -> Array:
    """Returns the luma frames [T, H, W] at poses [T], each of the world as it stands at its own time."""
    see = lambda p, q, t: view(config, scene_at(scene, t), p, q)  # noqa: E731
    return jax.vmap(see)(poses.position, poses.quaternion, poses.time)


def _last(scene: Scene, poses: Flight) -> tuple[Scene, Array, Array]:
    """Returns the world at the last of the poses, its position [3] and its quaternion [4]."""
    time = None if poses.time is None else poses.time[-1]
    return scene_at(scene, time), poses.position[-1], poses.quaternion[-1]


def _show_events(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    frames = _views(config, scene, poses)
    assert isinstance(memory, EventMemory)
    options = config.events
    return events.events(options, memory, frames, options.frame_times_s, key, continuous=options.stream)


def _show_event_image(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    """Returns log(1 + count) of each pixel's ON minus OFF events, with their sign."""
    field, memory = _show_events(config, scene, poses, memory, key)
    assert isinstance(field, EventField)
    image = events.event_image(field).astype(jnp.float32)
    return (jnp.sign(image) * jnp.log1p(jnp.abs(image))).ravel(), memory


def _event_memory(config: Config, key: Array) -> SensorMemory:
    lux = None
    if light.is_on(config.light):
        key, drawing = jax.random.split(key)
        lux = light.draw(config.light, drawing)
    return events.reset_memory(config.events, config.camera.height, config.camera.width, key, lux)


def _show_frame(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    if config.exposure.real:
        frames, memory = _exposed(config, scene, poses, memory, key)
        return brightness(config, frames), memory
    scene, position, quaternion = _last(scene, poses)
    return brightness(config, view(config, scene, position, quaternion))[None], None


def _exposed(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Array, SensorMemory]:
    """Returns pictures [T, H, W] that a camera takes, as shares of white, and its memory; see `exposure`.

    Args:
        poses: [T (K + 1)] up to the times of the frames.
    """
    assert isinstance(memory, FrameMemory)
    options, dt, lux = config.exposure, config.drone.physics_dt_s, memory.lux
    time, gain = exposure.settings(options, lux, memory.metered)
    of_frame = exposure.steps_touched(options, dt) + 1
    windows = jax.tree.map(lambda x: x.reshape(-1, of_frame, *x.shape[1:]), poses)
    within = jax.vmap(lambda window: exposure.poses_within(window, dt, time, options.sub_frames))(windows)
    views = _views(config, scene, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), within))
    luma = jnp.mean(views.reshape(-1, options.sub_frames, *views.shape[1:]), axis=1)
    frames = exposure.develop(options, luma, lux, time, gain, key)
    metered = exposure.metered(options, frames[-1], lux, time, gain)
    return frames, FrameMemory(lux=lux, metered=metered)


def _show_frame_pair(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    """Returns the newest frame and, of each frame before it, how much darker it was.

    That is all that is in the frames, and what moved is as large a number as what stands: in the frames as they are an
    encoder would have to take the small difference of two large numbers.
    """
    if config.exposure.real:
        frames, memory = _exposed(config, scene, poses, memory, key)
    else:
        frames = _views(config, scene, poses)
    frames = brightness(config, frames)
    change = (frames[-1:] - frames[:-1]) / CHANGE_SCALE
    return jnp.concatenate([frames[-1:], change]), memory


def brightness(config: Config, luma: Array) -> Array:
    """Returns what `frames` shows of a luma frame [..., H, W]: log brightness (Eq. 1), whose changes make events.

    In the logarithm a contrast is the same in light and in shade; brightness itself varies so little that the VAE
    leaves part of its code unused (docs/baselines.md).
    """
    return events.log_brightness(config.events, luma) - MID_GREY


def _show_depth(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    return nearness_image(config, *_last(scene, poses))[None], None


def _show_depth_motion(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    """Returns what `depth` shows, and the rate at which it changed by the obstacles' own motion alone.

    Both depths are seen from the last pose, so that the drone's own motion does not show.
    """
    now, position, quaternion = _last(scene, poses)
    near = nearness_image(config, now, position, quaternion)
    if poses.time is None:
        return jnp.stack([near, jnp.zeros_like(near)]), None
    # One program for both: compiled apart they round apart, and what stands still would have a rate.
    times = jnp.stack([poses.time[-1], poses.time[0]])
    near, before = jax.lax.map(lambda time: nearness_image(config, scene_at(scene, time), position, quaternion), times)
    rate = (near - before) / (poses.time[-1] - poses.time[0])
    return jnp.stack([near, jnp.tanh(rate / CLOSING_SCALE)]), None


def nearness_image(config: Config, scene: Scene, position: Array, quaternion: Array) -> Array:
    """Returns what `depth` shows [H, W] from a body at `position` [3], metres, with attitude `quaternion` [4]."""
    metres = camera.depth(config.camera, scene, position, mount_rotation(config, quaternion))
    return DEPTH_SCALE * nearness(metres)


def _show_ranges(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    scene, position, quaternion = _last(scene, poses)
    return nearness(ranges(config.camera, scene, position, drone.yaw_of(quaternion))), None


def nearness(distance: Array) -> Array:
    """Returns `1 / (1 + distance / HALF_NEAR_M)` of metres [...]: 1 at contact, 0 at infinity, steepest near 0."""
    return 1.0 / (1.0 + distance / HALF_NEAR_M)


def distance_of(nearness: Array) -> Array:
    """Returns the metres [...] of which `nearness` is that; 0 above 1, infinity from 0 down."""
    return HALF_NEAR_M * (1.0 / jnp.clip(nearness, 0.0, 1.0) - 1.0)


def ranges(config: CameraConfig, scene: Scene, position: Array, yaw: Array) -> Array:
    """Returns metres [26] from `position` [3] to the nearest shape or face of the flight volume along each move.

    Exact rays from the body's centre along `moves.DIRECTIONS` at heading `yaw` [] radians. The centre must be inside
    the volume and outside all shapes.
    """
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    ahead, left, up = jnp.asarray(DIRECTIONS.T)
    direction = jnp.stack([cos * ahead - sin * left, sin * ahead + cos * left, up])
    # One row of rays; the fields that describe a pixel's area do not affect where rays meet shapes.
    rays = Rays(
        dx=direction[None, 0],
        dy=direction[None, 1],
        dz=direction[None, 2],
        right=jnp.zeros(3),
        up=jnp.zeros(3),
        pitch=0.0,
        across=1,
        down=1,
    )
    to_shape = nearest_depth(config, scene, position, rays)[0]
    lower, upper = (jnp.abs(corner - position)[:, None] for corner in scene.volume)
    along = jnp.where(direction > 0, upper, lower) / jnp.maximum(jnp.abs(direction), raycast.TINY)
    to_face = jnp.min(jnp.where(jnp.abs(direction) > raycast.TINY, along, jnp.inf), axis=0)
    return jnp.minimum(to_shape, to_face)


def _show_nothing(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    return None, None


SENSORS: dict[str, Sensor] = {
    # The method's sensor.
    "events": Sensor(
        show=_show_events,
        form=Form.EVENTS,
        frame_times_s=_window,
        draws_frames=True,
        at_rest=_event_memory,
        image=Image("events", "events per pixel", signed=True),
    ),
    # The events as one image, without a VAE.
    "event-image": Sensor(
        show=_show_event_image,
        form=Form.VALUES,
        values=lambda config: config.camera.width * config.camera.height,
        frame_times_s=_window,
        draws_frames=True,
        at_rest=_event_memory,
    ),
    # The newest brightness frame of the same camera, perfect or as `exposure` has it.
    "frames": Sensor(
        show=_show_frame,
        form=Form.PICTURE,
        frame_times_s=lambda config: exposure.pose_times(config, (0.0,)),
        draws_frames=True,
        exposes=True,
        at_rest=exposure.at_rest,
        image=Image("log brightness", "log brightness + 1"),
    ),
    # The frames that the events are made of, at the same times.
    "frame-pair": Sensor(
        show=_show_frame_pair,
        form=Form.PICTURE,
        pictures=lambda config: len(_window(config)),
        frame_times_s=lambda config: exposure.pose_times(config, _window(config)),
        draws_frames=True,
        exposes=True,
        at_rest=exposure.at_rest,
        image=Image("log brightness", "log brightness + 1"),
    ),
    # True depth.
    "depth": Sensor(
        show=_show_depth,
        form=Form.PICTURE,
        draws_frames=True,
        image=Image("nearness", "nearness (3 is contact)"),
    ),
    # True depth, and how the obstacles' own motion changes it.
    "depth-motion": Sensor(
        show=_show_depth_motion,
        form=Form.PICTURE,
        pictures=lambda config: 2,
        frame_times_s=_window,
        draws_frames=True,
        image=Image("nearness", "nearness (3 is contact)"),
    ),
    # True free distance along each move, as nearness.
    "ranges": Sensor(show=_show_ranges, form=Form.VALUES, values=lambda config: len(DIRECTIONS)),
    # Nothing but the drone's own state.
    "blind": Sensor(show=_show_nothing, form=Form.NOTHING),
}
"""By `env.sensor`. `events` is the method's; the others are compared with it at the same budget."""
