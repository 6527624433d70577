"""What pixels remember from one window to the next, and what distinguishes a sensor's pixels from perfect ones.

Shapes: T frames, F = T - 1 frame pairs, H rows, W columns.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import NDArray

from edqn_jax.config import EventsConfig
from edqn_jax.sim.sensors import contrast, poisson, sensor_pixels
from edqn_jax.sim.sensors.events import max_events

MIN_THRESHOLD_GAIN = 0.1
"""Mismatch never makes a threshold smaller than this share of the nominal one."""

LEAST_SHARE = 1e-3
"""Of its faults that an episode's sensor always has, so that their inverse is finite."""

NO_FRAME = -1.0
"""Luma of `EventMemory.frame` before there is one."""

MOST_OF_PIXEL = 1_000_000
"""Events of a pixel between two frames that are never reached, where many pixels have no other limit."""


@struct.dataclass
class EventMemory:
    """State that a law carries from one window to the next; None for what a configuration does not need."""

    residual: Array | None  # [H, W] esim: log brightness of the last frame minus the pixel's reference level
    last_event: Array | None  # [H, W] esim: time of the last event, seconds from the end of the last window
    gain: Array | None  # [2, H, W] or [2, 1, 1] thresholds of ON and OFF, relative to the configured ones
    hot: Array | None  # [H, W] bool, pixels that fire on their own; with `sensor_pixels` how many do, int32
    lux: Array | None = None  # [] illuminance of the episode; None where there is always enough light
    lag: Array | None = None  # [H, W] with finite bandwidth: what the photoreceptor shows minus log brightness
    frame: Array | None = None  # [H, W] with finite bandwidth: luma of the last frame; -1 before the first
    contrast: Array | None = None  # [] log-brightness change per event; None where it is not drawn
    faults: Array | None = None  # [] share of its faults that the episode's sensor has; None is all


def reset_memory(config: EventsConfig, height: int, width: int, key: Array, lux: Array | None = None) -> EventMemory:
    """Returns the memory of a sensor at rest.

    esim's residuals are uniform in (-C-, C+); threshold mismatch and hot pixels are drawn. The same key gives the same
    sensor.

    Args:
        lux: [] illuminance of the scene; None where light does not matter.
    """
    drawn, faults = None, None
    if contrast.is_drawn(config):
        key, drawing = jax.random.split(key)
        drawn = contrast.sample_contrast(config, drawing)
    if config.faults_share > 0.0:
        key, drawing = jax.random.split(key)
        least = max(1.0 - config.faults_share, LEAST_SHARE)
        faults = jax.random.uniform(drawing, minval=least, maxval=1.0)
    key_residual, key_gain, key_hot = jax.random.split(key, 3)
    gain = _gain(config, (height, width), drawn, faults, key_gain)
    hot = None
    if config.hot_pixel_fraction > 0.0:
        share = config.hot_pixel_fraction * _or_1(faults)
        if config.sensor_pixels > 1:
            hot = poisson.sample_counts(key_hot, jnp.full((height, width), config.sensor_pixels * share))
        else:
            hot = jax.random.bernoulli(key_hot, share, (height, width))
    memory = EventMemory(residual=None, last_event=None, gain=gain, hot=hot, lux=lux, contrast=drawn, faults=faults)
    if config.bandwidth_hz > 0.0:
        size = (height, width)
        memory = dataclasses.replace(memory, lag=jnp.zeros(size), frame=jnp.full(size, NO_FRAME))
    if config.law != "esim":
        return memory
    contrast_on, contrast_off = thresholds(gain, config.contrast_on, config.contrast_off)
    share = jax.random.uniform(key_residual, (height, width))
    residual = share * (contrast_on + contrast_off) - contrast_off
    if config.sensor_pixels > 1:
        residual = share * 0.5 * (contrast_on + contrast_off)
    return dataclasses.replace(memory, residual=residual, last_event=jnp.full((height, width), -jnp.inf))


def _gain(
    config: EventsConfig, size: tuple[int, int], drawn: Array | None, faults: Array | None, key: Array
) -> Array | None:
    """Returns the thresholds relative to the configured ones [2, H, W], or [2, 1, 1] where pixels do not differ; None
    is 1.
    """
    gain = None if drawn is None else jnp.full((2, 1, 1), drawn / contrast.nominal_contrast(config))
    if config.threshold_mismatch > 0.0:
        noise, mismatch = jax.random.normal(key, (2, *size)), config.threshold_mismatch * _or_1(faults)
        mean = 1.0
        if config.sensor_pixels > 1:
            mean = 1.0 / sensor_pixels.mean_sensitivity(mismatch)
            mismatch = mismatch / config.sensor_pixels**0.5
        relative = jnp.maximum(mean + mismatch * noise, MIN_THRESHOLD_GAIN)
        gain = relative if gain is None else gain * relative
    return gain


def _or_1(share: Array | None) -> Array | float:
    return 1.0 if share is None else share


def is_scaled(config: EventsConfig) -> bool:
    """Returns whether fields have a `unit`."""
    return contrast.is_drawn(config) or config.sensor_pixels > 1


def unit_of(config: EventsConfig, drawn: Array | None) -> Array | None:
    """Returns what an event of sensors of contrasts [...] counts for the encoder [...]; None where it is 1."""
    if not is_scaled(config):
        return None
    known = jnp.float32(1.0) if drawn is None else drawn / contrast.REFERENCE
    return known / config.sensor_pixels


def thresholds(gain: Array | None, on: float, off: float) -> tuple[Array, Array]:
    """Returns ON and OFF thresholds, each a scalar or `[H, W]` with the sensor's mismatch."""
    if gain is None:
        return jnp.float32(on), jnp.float32(off)
    return gain[0] * on, gain[1] * off


def refractory_s(config: EventsConfig, faults: Array | None) -> Array | float:
    """Returns the least seconds between two events, [] or a number; of many pixels the mean of these."""
    period = config.refractory_ns * 1e-9
    return period if faults is None and config.sensor_pixels == 1 else period * _or_1(faults) / config.sensor_pixels


def limits(config: EventsConfig, times: NDArray, faults: Array | None) -> Array:
    """Returns the most events of all sensor pixels between two frames [F, 1, 1] int32."""
    if faults is None and config.sensor_pixels == 1:
        return jnp.array([max_events(config, dt) for dt in np.diff(times)], jnp.int32)[:, None, None]
    if config.refractory_ns <= 0.0:
        return jnp.full((len(times) - 1, 1, 1), config.sensor_pixels * MOST_OF_PIXEL, jnp.int32)
    # Rounding must not take away the event that just fits.
    whole = jnp.floor(jnp.asarray(np.diff(times) / (config.refractory_ns * 1e-9)) / _or_1(faults) + 1e-4)
    return config.sensor_pixels * jnp.minimum(whole, MOST_OF_PIXEL).astype(jnp.int32)[:, None, None]
