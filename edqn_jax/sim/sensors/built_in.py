"""The package's own sensors; `config.registry.SENSORS` has them by name."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from edqn_jax.config import Config
from edqn_jax.sim.actions import DIRECTIONS
from edqn_jax.sim.physics import drone
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.scene import Scene, scene_at
from edqn_jax.sim.sensors import event_field, event_laws, event_memory, exposure, light
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.sensors.event_memory import EventMemory
from edqn_jax.sim.sensors.exposure import FrameMemory
from edqn_jax.sim.sensors.sensor import (
    EVENT_FIELD,
    Image,
    Sensed,
    Sensor,
    SensorMemory,
    brightness,
    last_view,
    move_ranges,
    nearness,
    nearness_image,
    render_view,
    signed_log,
)

CHANGE_SCALE = 0.1
"""Change of log brightness that `frame-pair` shows as 1: that of two or three events."""

CLOSING_SCALE = 0.5
"""Rate at which `depth-motion` shows obstacles come nearer, 1/s, per unit before it saturates: of `depth`'s own
values, 3 m/s at a distance of 4 m."""


def _views(config: Config, scene: Scene, poses: Flight) -> Array:
    """Returns the luma frames [T, H, W] at poses [T], each of the world as it stands at its own time."""
    see = lambda p, q, t: render_view(config, scene_at(scene, t), p, q)  # noqa: E731
    return jax.vmap(see)(poses.position, poses.quaternion, poses.time)


def _show_events(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    frames = _views(config, scene, poses)
    assert isinstance(memory, EventMemory)
    options, times = config.events, config.events.frame_times_s
    gap_s = max(config.drone.physics_steps * config.drone.physics_dt_s + times[0], 0.0)
    return event_laws.generate_events(options, memory, frames, times, key, continuous=options.stream, gap_s=gap_s)


def _show_event_image(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    """Returns log(1 + count) of each pixel's ON minus OFF events, with their sign."""
    field, memory = _show_events(config, scene, poses, memory, key)
    assert isinstance(field, EventField)
    return signed_log(event_field.image_in_units(field)).ravel(), memory


def _event_memory(config: Config, key: Array) -> SensorMemory:
    lux = None
    if light.is_on(config.light):
        key, drawing = jax.random.split(key)
        lux = light.sample_illuminance(config.light, drawing)
    return event_memory.reset_memory(config.events, config.camera.height, config.camera.width, key, lux)


def _show_frame(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    if not exposure.is_perfect(config.exposure):
        frames, memory = _take_frames(config, scene, poses, memory, key, (0.0,))
        return brightness(config, frames), memory
    scene, position, quaternion = last_view(scene, poses)
    return brightness(config, render_view(config, scene, position, quaternion))[None], None


def _take_frames(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array, times: tuple[float, ...]
) -> tuple[Array, SensorMemory]:
    """Returns the pictures [T, H, W] that a camera takes, as shares of white, and its memory; see `exposure`.

    Args:
        poses: at the times of `exposure.pose_times`.
        times: [T] seconds, when a camera without a clock takes them.
    """
    assert isinstance(memory, FrameMemory)
    lux, metered, time, gain = memory.lux, memory.metered, jnp.zeros(()), jnp.ones(())
    options = config.exposure
    if lux is not None and metered is not None:
        time, gain = exposure.exposure_settings(options, lux, metered)
    within, clock = exposure.poses_of_frames(config, memory.clock, poses, time, times)
    views = _views(config, scene, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), within))
    frames = jnp.mean(views.reshape(len(times), -1, *views.shape[1:]), axis=1)
    if lux is not None and metered is not None:
        frames = exposure.develop_picture(options, frames, lux, time, gain, key)
        measured = exposure.meter_brightness(options, frames[-1], lux, time, gain)
        metered = exposure.follow_brightness(config, metered, measured)
    return frames, FrameMemory(lux=lux, metered=metered, clock=clock)


def _show_frame_pair(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    """Returns the newest frame and, of each frame before it, how much darker it was.

    That is all that is in the frames, and what moved is as large a number as what stands: in the frames as they are an
    encoder would have to take the small difference of two large numbers.
    """
    if exposure.is_perfect(config.exposure):
        frames = _views(config, scene, poses)
    else:
        frames, memory = _take_frames(config, scene, poses, memory, key, _window(config))
    frames = brightness(config, frames)
    change = (frames[-1:] - frames[:-1]) / CHANGE_SCALE
    return jnp.concatenate([frames[-1:], change]), memory


def _show_depth(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    return nearness_image(config, *last_view(scene, poses))[None], None


def _show_depth_motion(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    """Returns the image of `depth`, and its rate of change due to the obstacles' own motion alone.

    Both depths are seen from the last pose, so that the drone's own motion does not show.
    """
    now, position, quaternion = last_view(scene, poses)
    near = nearness_image(config, now, position, quaternion)
    if poses.time is None:
        return jnp.stack([near, jnp.zeros_like(near)]), None
    # One program for both: compiled apart they round apart, and what stands still would have a rate.
    times = jnp.stack([poses.time[-1], poses.time[0]])
    near, before = jax.lax.map(lambda time: nearness_image(config, scene_at(scene, time), position, quaternion), times)
    rate = (near - before) / (poses.time[-1] - poses.time[0])
    return jnp.stack([near, jnp.tanh(rate / CLOSING_SCALE)]), None


def _show_ranges(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    scene, position, quaternion = last_view(scene, poses)
    return nearness(move_ranges(config.camera, scene, position, drone.yaw_of(quaternion))), None


def _show_nothing(
    config: Config, scene: Scene, poses: Flight, memory: SensorMemory, key: Array
) -> tuple[Sensed, SensorMemory]:
    return None, None


def _window(config: Config) -> tuple[float, ...]:
    return config.events.frame_times_s


def _pictures(count: int, config: Config) -> tuple[int, int, int]:
    return count, config.camera.height, config.camera.width


EVENTS = Sensor(
    show=_show_events,
    shape=lambda config: EVENT_FIELD,
    makes_events=True,
    frame_times_s=_window,
    draws_frames=True,
    at_rest=_event_memory,
    image=Image("events", "events per pixel", signed=True),
)

EVENT_IMAGE = Sensor(
    show=_show_event_image,
    shape=lambda config: (config.camera.width * config.camera.height,),
    makes_events=True,
    frame_times_s=_window,
    draws_frames=True,
    at_rest=_event_memory,
)

FRAMES = Sensor(  # of the same camera, perfect or as `exposure` has it
    show=_show_frame,
    shape=lambda config: _pictures(1, config),
    frame_times_s=lambda config: exposure.pose_times(config, (0.0,)),
    draws_frames=True,
    exposes=True,
    at_rest=lambda config, key: exposure.at_rest(config, key, (0.0,)),
    image=Image("log brightness", "log brightness + 1"),
)

FRAME_PAIR = Sensor(  # at the times of the frames that events are made of
    show=_show_frame_pair,
    shape=lambda config: _pictures(len(_window(config)), config),
    frame_times_s=lambda config: exposure.pose_times(config, _window(config)),
    draws_frames=True,
    exposes=True,
    at_rest=lambda config, key: exposure.at_rest(config, key, _window(config)),
    image=Image("log brightness", "log brightness + 1"),
)

DEPTH = Sensor(
    show=_show_depth,
    shape=lambda config: _pictures(1, config),
    draws_frames=True,
    image=Image("nearness", "nearness (3 is contact)"),
)

DEPTH_MOTION = Sensor(
    show=_show_depth_motion,
    shape=lambda config: _pictures(2, config),
    frame_times_s=_window,
    draws_frames=True,
    image=Image("nearness", "nearness (3 is contact)"),
)

RANGES = Sensor(show=_show_ranges, shape=lambda config: (len(DIRECTIONS),))

BLIND = Sensor(show=_show_nothing)
