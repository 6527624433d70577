"""A camera that takes frames: exposure time, motion blur, photon and read noise, a full well, levels; and its clock.

Photons arrive at random, so N electrons have a standard deviation of sqrt(N); reading them adds `read_noise_e` (EMVA
standard 1288, the linear camera model, without dark current). A picture is the sum of the light over its exposure: here
the mean of `sub_frames` pictures from where the drone was in the middle of as many equal parts of it.

The camera sets exposure time and gain from its own last picture, once a decision: all frames of a decision share them.
A perfect camera may have a clock alone. T frames, S sub-frames, K physics steps that the longest exposure may touch.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from edqn_jax.config import Config, ExposureConfig
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.sensors import frame_clock, light
from edqn_jax.sim.sensors.frame_clock import Clock, poses_before

AT_REST = 0.4
"""Mean brightness that a camera expects before its first picture: about that of a scene with some sky."""

DARKEST = 1e-3
"""Mean brightness below which a camera does not expect any; it only bounds the gain that is asked for."""


@struct.dataclass
class FrameMemory:
    """State of a frame camera between decisions; None for what a configuration does not need."""

    lux: Array | None  # [] illuminance of the episode
    metered: Array | None  # [] mean brightness of the last picture, as a share of a surface that faces the sun
    clock: Clock | None = None


def is_perfect(exposure: ExposureConfig) -> bool:
    """Returns whether frames have neither an exposure nor a clock, so that the camera has no memory."""
    return not (exposure.real or frame_clock.is_on(exposure))


def at_rest(config: Config, key: Array, frame_times_s: tuple[float, ...]) -> FrameMemory | None:
    """Returns the memory before the first decision; None for a perfect camera. `key` is consumed."""
    options, clock = config.exposure, None
    if is_perfect(options):
        return None
    if frame_clock.is_on(options):
        key, drawing = jax.random.split(key)
        clock = frame_clock.at_rest(config, frame_times_s, drawing)
    if not options.real:
        return FrameMemory(None, None, clock)
    return FrameMemory(light.sample_illuminance(config.light, key), jnp.float32(AT_REST), clock)


def steps_touched(exposure: ExposureConfig, dt_s: float) -> int:
    """Returns K, how many physics steps of `dt_s` seconds the longest exposure reaches into."""
    return max(math.ceil(exposure.longest_s / dt_s - 1e-6), 1)


def pose_times(config: Config, frame_times_s: tuple[float, ...]) -> tuple[float, ...]:
    """Returns when poses are needed for frames at these times: K + 1 for each, one for a perfect camera, and all of the
    decision for one with a clock.
    """
    options, dt = config.exposure, config.drone.physics_dt_s
    if frame_clock.is_on(options):
        return tuple(-dt * step for step in range(config.drone.physics_steps, -1, -1))
    if not options.real:
        return frame_times_s
    back = range(steps_touched(options, dt), -1, -1)
    return tuple(time - dt * step for time in frame_times_s for step in back)


def poses_of_frames(
    config: Config, clock: Clock | None, poses: Flight, time: Array, frame_times_s: tuple[float, ...]
) -> tuple[Flight, Clock | None]:
    """Returns the poses [T, S] from which frames are taken, newest first in each, and the next clock.

    Of an exposure of `time` [] seconds they are in the middle of S equal parts of it; a perfect frame has one.

    Args:
        config: of exposure and drone.
        clock: None for a camera whose frames end at `frame_times_s`.
        poses: at the times of `pose_times`.
        time: [] seconds, 0 for a perfect frame.
        frame_times_s: [T] as of a camera without a clock.
    """
    options, dt = config.exposure, config.drone.physics_dt_s
    count = options.sub_frames if options.real else 1
    parts = time / dt * (jnp.arange(count) + 0.5) / count  # in physics steps
    if clock is None:
        of_frame = steps_touched(options, dt) + 1
        windows = jax.tree.map(lambda x: x.reshape(-1, of_frame, *x.shape[1:]), poses)
        return jax.vmap(lambda window: poses_before(window, parts))(windows), None
    path, ages, clock = frame_clock.read_clock(config, clock, poses, frame_times_s)
    return jax.vmap(lambda age: poses_before(path, age / dt + parts))(ages), clock


def exposure_settings(exposure: ExposureConfig, lux: Array, metered: Array) -> tuple[Array, Array]:
    """Returns exposure time [] seconds and gain [] with which a picture of mean brightness `metered` is at the target.

    The time comes first; gain, which amplifies noise as well, is what the longest exposure leaves to be done.
    """
    white = exposure.sensitivity_e_lux_s * lux / exposure.full_well_e  # of the full well, per second
    wanted = exposure.target / (white * jnp.maximum(metered, DARKEST))
    time = jnp.clip(wanted, exposure.shortest_s, frame_clock.longest_exposure_s(exposure))
    return time, jnp.clip(wanted / time, 1.0, exposure.most_gain)


def develop_picture(exposure: ExposureConfig, luma: Array, lux: Array, time: Array, gain: Array, key: Array) -> Array:
    """Returns the picture [...] of mean luma [...]: levels of `bits` as shares of white. `key` is consumed.

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
    white = 2.0**exposure.bits - 1.0
    levels = jnp.round(white * gain * read / exposure.full_well_e)
    return jnp.clip(levels, 0.0, white) / white


def meter_brightness(exposure: ExposureConfig, picture: Array, lux: Array, time: Array, gain: Array) -> Array:
    """Returns the mean scene brightness [] estimated from a picture [...], a lower bound where it clips.

    Args:
        picture: shares of white.
        lux, time, gain: illuminance in lux, seconds of exposure, and gain, as in `develop_picture`.
    """
    return jnp.mean(picture) * exposure.full_well_e / (exposure.sensitivity_e_lux_s * lux * time * gain)


def follow_brightness(config: Config, metered: Array, measured: Array) -> Array:
    """Returns the mean brightness [] that the next exposure is set for, a decision after `metered` [] was.

    It follows what is `measured` [] of the picture with the time constant `metering_s`, in the logarithm.
    """
    if not config.exposure.metering_s:
        return measured
    left = math.exp(-config.drone.physics_steps * config.drone.physics_dt_s / config.exposure.metering_s)
    before, now = jnp.log(jnp.maximum(metered, DARKEST)), jnp.log(jnp.maximum(measured, DARKEST))
    return jnp.exp(now + left * (before - now))
