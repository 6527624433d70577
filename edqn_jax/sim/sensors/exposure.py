"""A camera that takes frames: exposure time, motion blur, photon and read noise, a full well, 8 bits.

Photons arrive at random, so N electrons have a standard deviation of sqrt(N); reading them adds `read_noise_e` (EMVA
standard 1288, the linear camera model, without dark current). A picture is the sum of the light over its exposure: here
the mean of `sub_frames` pictures from where the drone was in the middle of as many equal parts of it.

The camera sets exposure time and gain from its own last picture, once a decision: all frames of a decision share them.
S sub-frames, K physics steps that the longest exposure may touch.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.config import Config, ExposureConfig
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.sensors import light

WHITE = 255.0
"""Largest value of 8 bits."""

AT_REST = 0.4
"""Mean brightness that a camera expects before its first picture: about that of a scene with some sky."""

DARKEST = 1e-3
"""Mean brightness below which a camera does not expect any; it only bounds the gain that is asked for."""


@struct.dataclass
class FrameMemory:
    """State of a frame camera between decisions."""

    lux: Array  # [] illuminance of the episode
    metered: Array  # [] mean brightness of the last picture, as a share of a surface that faces the sun


def at_rest(config: Config, key: Array) -> FrameMemory | None:
    """Returns the memory before the first decision; None for a perfect camera. `key` is consumed."""
    if not config.exposure.real:
        return None
    return FrameMemory(lux=light.sample_illuminance(config.light, key), metered=jnp.float32(AT_REST))


def steps_touched(exposure: ExposureConfig, dt_s: float) -> int:
    """Returns K, how many physics steps of `dt_s` seconds the longest exposure reaches into."""
    return max(math.ceil(exposure.longest_s / dt_s - 1e-6), 1)


def pose_times(config: Config, frame_times_s: tuple[float, ...]) -> tuple[float, ...]:
    """Returns when poses are needed for frames at these times: K + 1 for each, or one for a perfect camera."""
    if not config.exposure.real:
        return frame_times_s
    dt = config.drone.physics_dt_s
    back = range(steps_touched(config.exposure, dt), -1, -1)
    return tuple(time - dt * step for time in frame_times_s for step in back)


def exposure_settings(exposure: ExposureConfig, lux: Array, metered: Array) -> tuple[Array, Array]:
    """Returns exposure time [] seconds and gain [] with which a picture of mean brightness `metered` is at the target.

    The time comes first; gain, which amplifies noise as well, is what the longest exposure leaves to be done.
    """
    white = exposure.sensitivity_e_lux_s * lux / exposure.full_well_e  # of the full well, per second
    wanted = exposure.target / (white * jnp.maximum(metered, DARKEST))
    time = jnp.clip(wanted, exposure.shortest_s, exposure.longest_s)
    return time, jnp.clip(wanted / time, 1.0, exposure.most_gain)


def poses_within(poses: Flight, dt_s: float, time: Array, count: int) -> Flight:
    """Returns poses [S] in the middle of `count` equal parts of an exposure of `time` [] s that ends at the last pose.

    Positions and times are interpolated linearly between physics steps, attitudes linearly and then normalised.

    Args:
        poses: [K + 1] after physics steps of `dt_s` seconds in a row.
    """
    last = poses.position.shape[0] - 1
    before = time / dt_s * (jnp.arange(count) + 0.5) / count  # in physics steps, newest first
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


def develop_picture(exposure: ExposureConfig, luma: Array, lux: Array, time: Array, gain: Array, key: Array) -> Array:
    """Returns the picture [...] of mean luma [...]: 8-bit levels as shares of white. `key` is consumed.

    The Poisson distribution of electrons is taken for a normal one of its variance, which is far off only where there
    are fewer than `read_noise_e` squared anyway.

    Args:
        luma: share of a surface that faces the sun.
        lux: [] illuminance.
        time: [] seconds of exposure.
        gain: [] without a unit.
    """
    electrons = exposure.sensitivity_e_lux_s * lux * time * luma
    spread = jnp.sqrt(electrons + exposure.read_noise_e**2)
    read = electrons + spread * jax.random.normal(key, luma.shape)
    levels = jnp.round(WHITE * gain * read / exposure.full_well_e)
    return jnp.clip(levels, 0.0, WHITE) / WHITE


def meter_brightness(exposure: ExposureConfig, picture: Array, lux: Array, time: Array, gain: Array) -> Array:
    """Returns the mean scene brightness [] estimated from a picture [...], a lower bound where it clips.

    Args:
        picture: shares of white.
        lux, time, gain: illuminance in lux, seconds of exposure, and gain, as in `develop_picture`.
    """
    return jnp.mean(picture) * exposure.full_well_e / (exposure.sensitivity_e_lux_s * lux * time * gain)
