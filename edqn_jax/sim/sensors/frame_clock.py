"""The clock of a frame camera: it exposes at a rate of its own, and a frame can be used some time later.

A decision sees the newest frame whose transfer has ended, so that what it sees is older by up to a period and the
latency. The phase is drawn for each episode. Frames are taken from where the drone was then, which may be before the
decision began: poses of the physics steps before it are remembered. What moves is seen where it was then; only the
other drones of a group are where they were as the decision began, at the earliest.

T frames of a decision, n physics steps of a decision, M steps before it that a frame may reach into.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import NDArray

from edqn_jax.config import Config, ExposureConfig
from edqn_jax.sim.physics.drone import Flight


@struct.dataclass
class Clock:
    """State between decisions; None for what a configuration does not need."""

    ready: Array | None  # [] seconds from the end of the newest frame's transfer to the next observation
    past: Flight | None  # [M] poses of the physics steps before the next decision, oldest first, without times
    begun: Array  # [] bool, whether there was an observation
    attitudes: Array | None = None  # [T, 4] of the body at the ends of the last observation's frames; None if level


def is_on(exposure: ExposureConfig) -> bool:
    """Returns whether frames are older than the times at which a perfect camera would look."""
    return exposure.rate_hz > 0.0 or exposure.latency_s > 0.0


def longest_exposure_s(exposure: ExposureConfig) -> float:
    """Returns the longest exposure, seconds: no longer than the period of the frames."""
    return min(exposure.longest_s, 1.0 / exposure.rate_hz) if exposure.rate_hz else exposure.longest_s


def frame_offsets_s(exposure: ExposureConfig, frame_times_s: tuple[float, ...]) -> NDArray:
    """Returns how much older than the newest frame each of them is [T], seconds.

    With a rate they are whole periods apart: as many as come nearest to these times, and at least one.
    """
    if not exposure.rate_hz:
        return -np.asarray(frame_times_s)
    numbers = [0]
    for time in frame_times_s[-2::-1]:
        numbers.insert(0, max(round(-time * exposure.rate_hz), numbers[0] + 1))
    return np.asarray(numbers) / exposure.rate_hz


def steps_before(config: Config, frame_times_s: tuple[float, ...]) -> int:
    """Returns M, the physics steps before a decision into which the oldest frame's exposure may reach."""
    options, dt = config.exposure, config.drone.physics_dt_s
    period = 1.0 / options.rate_hz if options.rate_hz else 0.0
    exposed = longest_exposure_s(options) if options.real else 0.0
    reach = options.latency_s + period + float(frame_offsets_s(options, frame_times_s)[0]) + exposed
    return max(math.ceil(reach / dt - 1e-6) - config.drone.physics_steps, 0)


def at_rest(config: Config, frame_times_s: tuple[float, ...], key: Array) -> Clock:
    """Returns the clock of an episode before its first observation; `key` is consumed."""
    rate, past = config.exposure.rate_hz, None
    before = steps_before(config, frame_times_s)
    if before:
        past = Flight(
            position=jnp.zeros((before, 3)), quaternion=jnp.zeros((before, 4)), velocity=jnp.zeros((before, 3))
        )
    ready = jax.random.uniform(key, maxval=1.0 / rate) if rate else None
    attitudes = jnp.zeros((len(frame_times_s), 4)) if config.camera.mount == "body" else None
    return Clock(ready=ready, past=past, begun=jnp.zeros((), bool), attitudes=attitudes)


def read_clock(
    config: Config, clock: Clock, poses: Flight, frame_times_s: tuple[float, ...]
) -> tuple[Flight, Array, Clock]:
    """Returns the poses [M + n + 1] up to an observation, seconds [T] from frames' ends to it, and the next clock.

    Args:
        config: of exposure and drone.
        clock: from `at_rest` or the decision before.
        poses: [n + 1] from the beginning of the decision on.
        frame_times_s: as of a camera without a clock.
    """
    options, ready = config.exposure, clock.ready
    age = jnp.asarray(options.latency_s + frame_offsets_s(options, frame_times_s), jnp.float32)
    if ready is not None:
        age = age + ready
        ready = jnp.mod(ready + config.drone.physics_steps * config.drone.physics_dt_s, 1.0 / options.rate_hz)
    path, past = poses, clock.past
    if past is not None:
        path = _with_past(past, clock.begun, poses, config.drone.physics_dt_s)
        count = past.position.shape[0]
        past = jax.tree.map(lambda x: x[-count - 1 : -1], dataclasses.replace(path, time=None))
    attitudes = clock.attitudes
    if attitudes is not None:
        attitudes = poses_before(path, age / config.drone.physics_dt_s).quaternion
    return path, age, Clock(ready=ready, past=past, begun=jnp.ones((), bool), attitudes=attitudes)


def _with_past(past: Flight, begun: Array, poses: Flight, dt_s: float) -> Flight:
    """Returns the poses with those before them; before an episode's first observation the drone stood still."""
    before = jax.tree.map(lambda old, new: jnp.where(begun, old, new[:1]), past, dataclasses.replace(poses, time=None))
    path = jax.tree.map(lambda old, new: jnp.concatenate([old, new]), before, dataclasses.replace(poses, time=None))
    if poses.time is None:
        return path
    times = poses.time[0] - dt_s * jnp.arange(past.position.shape[0], 0, -1)
    return dataclasses.replace(path, time=jnp.concatenate([times, poses.time]))


def poses_before(poses: Flight, before: Array) -> Flight:
    """Returns the poses [S] at `before` [S] physics steps before the last of the poses.

    Positions and times are interpolated linearly between physics steps, attitudes linearly and then normalised.

    Args:
        poses: [K + 1] after physics steps in a row.
        before: 0 to K, fractions too.
    """
    last = poses.position.shape[0] - 1
    step = jnp.clip(jnp.floor(before), 0, last - 1).astype(jnp.int32)
    share = before - step

    def between(values: Array) -> Array:
        new, old = values[last - step], values[last - step - 1]
        return new + share.reshape(-1, *[1] * (values.ndim - 1)) * (old - new)

    # A quaternion and its negative are one attitude: neighbours must not be opposite ones.
    quaternion = poses.quaternion
    turned = jnp.sign(jnp.sum(quaternion[1:] * quaternion[:-1], axis=-1, keepdims=True) + 1e-9)
    signs = jnp.concatenate([jnp.ones((1, 1)), jnp.cumprod(turned, axis=0)])
    mixed = between(quaternion * signs)
    return Flight(
        position=between(poses.position),
        quaternion=mixed * jax.lax.rsqrt(jnp.sum(mixed * mixed, axis=-1, keepdims=True)),
        velocity=between(poses.velocity),
        time=None if poses.time is None else between(poses.time),
    )
