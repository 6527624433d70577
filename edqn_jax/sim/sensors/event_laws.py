"""The events of a window's frames under three laws: `paper`, `airsim` and `esim`.

Shapes: T frames, F = T - 1 frame pairs (2 F rows in an `EventField` when noise events are on), H rows, W columns.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from edqn_jax.config import EventsConfig
from edqn_jax.sim.sensors import photoreceptor, sensor_pixels
from edqn_jax.sim.sensors.event_field import MICROSECOND, EventField
from edqn_jax.sim.sensors.event_memory import (
    EventMemory,
    is_scaled,
    limits,
    refractory_s,
    thresholds,
    unit_of,
)
from edqn_jax.sim.sensors.event_noise import has_noise, merge_fields, noise_events, split_polarity
from edqn_jax.sim.sensors.events import (
    airsim_count,
    airsim_log_brightness,
    event_count,
    event_polarity,
    event_times,
    log_brightness,
)


def generate_events(
    config: EventsConfig,
    memory: EventMemory,
    frames: Array,
    frame_times: Sequence[float],
    key: Array,
    *,
    continuous: bool = False,
    gap_s: float | None = None,
) -> tuple[EventField, EventMemory]:
    """Returns the events of one window, and the memory after it.

    Args:
        memory: from `reset_memory` or the window before.
        frames: `[T, H, W]` linear luma in [0, 1], each pixel its area average.
        frame_times: T times in seconds, rising; only their differences matter. Known when tracing.
        key: consumed only by noise events.
        continuous: the first frame is the previous window's last one (`stream` mode), so that esim's
            refractory clock runs on. Otherwise there is a gap between the windows, and esim's reference is set at the
            first frame, keeping each pixel's sub-threshold residual.
        gap_s: seconds between the previous window's last frame and the first one, in which brightness is taken to
            change linearly, so that the lag of photoreceptors runs on; 0 if `continuous`. None: not known, and they
            have settled at the first frame, as they have at that of the first window.

    Raises:
        ValueError: if there are fewer than two frames, or not one rising time for each.
    """
    times = np.asarray(frame_times, np.float64)
    if frames.shape[0] < 2 or times.shape != (frames.shape[0],) or np.any(np.diff(times) <= 0.0):
        raise ValueError(
            f"events need at least two frames and one rising time for each; got {frames.shape[0]} frames "
            f"and times {times.tolist()}"
        )
    times = times - times[0]
    window_s = float(times[-1])
    key, dither = jax.random.split(key) if config.sensor_pixels > 1 else (key, key)
    level = _level(config, frames)
    current = None
    if config.bandwidth_hz > 0.0 or (memory.lux is not None and config.shot_rate_hz > 0.0):
        current = photoreceptor.between_frames(photoreceptor.photocurrent(frames, _light(config, memory)))
    if config.bandwidth_hz > 0.0:
        level, memory = _follow_light(config, memory, frames, times, 0.0 if continuous else gap_s)
    if config.sensor_pixels > 1:
        field, memory = _many_pixels(config, memory, level, times, dither)
    elif config.law == "esim":
        field, memory = _esim(config, memory, level, times, continuous)
    else:
        field = _frame_pairs(config, memory, level, times)
    noisy = has_noise(config)
    if noisy:
        shot = 1.0 if current is None else photoreceptor.shot_noise(current)
        noise = noise_events(config, memory.hot, field.count, times, key, shot, memory.faults)
        field = merge_fields(config, split_polarity(field), noise, times, memory.faults)
    even, unit = divides_window(config, len(times)), unit_of(config, memory.contrast)
    return dataclasses.replace(field, window_s=window_s, divides_window=even, with_noise=noisy, unit=unit), memory


def _level(config: EventsConfig, frames: Array) -> Array:
    """Returns Eq. 1 of the law, of luma [...]."""
    return airsim_log_brightness(frames) if config.law == "airsim" else log_brightness(config, frames)


def _light(config: EventsConfig, memory: EventMemory) -> Array | float:
    """Returns the illuminance as a share of `reference_lux`; 1 where there is always enough."""
    return 1.0 if memory.lux is None else memory.lux / config.reference_lux


def _follow_light(
    config: EventsConfig, memory: EventMemory, frames: Array, times: NDArray, gap_s: float | None
) -> tuple[Array, EventMemory]:
    """Returns what photoreceptors show at the frames [T, H, W], and the memory with their lag after the last."""
    lag, count = jnp.zeros(frames.shape[1:]), len(times)
    if gap_s is not None and memory.lag is not None and memory.frame is not None:
        # The gap is one more frame pair. Before an episode's first frame the pixels have settled at it.
        begun = memory.frame >= 0.0
        frames = jnp.concatenate([jnp.where(begun, memory.frame, frames[0])[None], frames])
        lag, times = memory.lag, np.concatenate([[times[0] - gap_s], times])
    current = photoreceptor.between_frames(photoreceptor.photocurrent(frames, _light(config, memory)))
    current = current if memory.faults is None else current / memory.faults
    shown, lag = photoreceptor.filter_log_brightness(config.bandwidth_hz, _level(config, frames), times, current, lag)
    return shown[-count:], dataclasses.replace(memory, lag=lag, frame=frames[-1])


def divides_window(config: EventsConfig, frames: int) -> bool:
    """Returns whether each pixel's events divide a window of so many frames evenly, see `EventField`."""
    return frames == 2 and config.law != "esim" and not has_noise(config)


def random_field(config: EventsConfig, height: int, width: int, rng: np.random.Generator) -> EventField:
    """Returns a field [F, H, W] of 0 to 2 events per pixel and frame pair, all at time 0; for measurements."""
    shape = (max(len(config.frame_times_s) - 1, 1), height, width)
    count, times = jnp.asarray(rng.integers(0, 3, shape), jnp.int32), jnp.zeros(shape)
    window_s = config.frame_times_s[-1] - config.frame_times_s[0]
    even = divides_window(config, len(config.frame_times_s))
    unit = jnp.ones(()) if is_scaled(config) else None
    return EventField(count, jnp.sign(count).astype(jnp.int8), times, times, window_s, even, unit=unit)


def _many_pixels(
    config: EventsConfig, memory: EventMemory, level: Array, times: NDArray, key: Array
) -> tuple[EventField, EventMemory]:
    """Returns the events of `sensor_pixels` pixels together under each of ours, evenly spaced between two frames."""
    intervals, change = np.diff(times), jnp.diff(level, axis=0)
    if config.law == "esim":
        on, off = thresholds(memory.gain, config.contrast_on, config.contrast_off)
        assert memory.residual is not None

        def pair(residual: Array, change: Array) -> tuple[Array, Array]:
            expected, residual = sensor_pixels.follow(residual, change, on, off)
            return residual, expected

        residual, signed = jax.lax.scan(pair, memory.residual, change, unroll=min(len(intervals), 2))
        memory = dataclasses.replace(memory, residual=residual)
    else:
        on, off = thresholds(memory.gain, config.tolerance, config.tolerance)
        signed = change / jnp.where(change > 0.0, on, off)
    drawn = sensor_pixels.count_all(jnp.abs(signed), config.sensor_pixels, key)
    count = jnp.minimum(drawn, limits(config, times, memory.faults))
    starts = jnp.asarray(times[:-1, None, None], jnp.float32)
    t_first, t_step = event_times(count, starts, jnp.asarray(intervals[:, None, None], jnp.float32))
    polarity = jnp.where(count > 0, jnp.sign(signed), 0.0).astype(jnp.int8)
    return EventField(count, polarity, t_first, t_step, 0.0), memory


def _frame_pairs(config: EventsConfig, memory: EventMemory, level: Array, times: NDArray) -> EventField:
    """Returns the events of the memoryless laws, `paper` and `airsim`."""
    intervals, gain = np.diff(times), memory.gain
    limit = limits(config, times, memory.faults)
    before, after = level[:-1], level[1:]
    change = after - before
    scale: Array | float = 1.0 if gain is None else jnp.where(change > 0.0, gain[0], gain[1])
    if config.law == "paper":
        over = event_polarity(change, scale * config.threshold)
        count = jnp.where(over != 0, event_count(change, scale * config.tolerance, limit), 0)
    else:
        count = airsim_count(before, after, scale * config.airsim_tolerance, limit)
        over = jnp.sign(change).astype(jnp.int8)
    starts = jnp.asarray(times[:-1, None, None], jnp.float32)
    t_first, t_step = event_times(count, starts, jnp.asarray(intervals[:, None, None], jnp.float32))
    return EventField(count, jnp.where(count > 0, over, 0).astype(jnp.int8), t_first, t_step, 0.0)


def _esim(
    config: EventsConfig, memory: EventMemory, level: Array, times: NDArray, continuous: bool
) -> tuple[EventField, EventMemory]:
    """Returns the events of a sensor with memory, over the window's frame pairs one after another."""
    assert memory.residual is not None and memory.last_event is not None
    last_event = memory.last_event if continuous else jnp.full_like(memory.last_event, -jnp.inf)
    starts, ends = jnp.asarray(times[:-1], jnp.float32), jnp.asarray(times[1:], jnp.float32)
    contrasts = thresholds(memory.gain, config.contrast_on, config.contrast_off)

    def pair(carry: tuple[Array, Array], xs: tuple[Array, ...]) -> tuple[tuple[Array, Array], EventField]:
        return _esim_pair(config, memory.faults, contrasts, carry, xs)

    carry, field = jax.lax.scan(
        pair,
        (memory.residual, last_event),
        (level[:-1], level[1:], starts, ends),
        unroll=min(len(times) - 1, 2),  # a window of two or three frames needs no loop
    )
    residual, last_event = carry
    return field, dataclasses.replace(memory, residual=residual, last_event=last_event - ends[-1])


def _esim_pair(
    config: EventsConfig,
    faults: Array | None,
    contrasts: tuple[Array, Array],
    carry: tuple[Array, Array],
    pair: tuple[Array, ...],
) -> tuple[tuple[Array, Array], EventField]:
    """Returns crossings of the reference's next levels while brightness changes linearly between two frames."""
    residual, last_event = carry
    before, after, start, end = pair
    change = after - before
    rising = change > 0.0
    contrast = jnp.where(rising, contrasts[0], contrasts[1])
    offset = jnp.where(rising, residual, -residual)  # distance from the reference, in the direction of travel
    size = jnp.abs(change)
    crossings = jnp.maximum(jnp.floor((offset + size) / contrast), 0.0).astype(jnp.int32)
    residual = residual + change - jnp.where(rising, 1.0, -1.0) * contrast * crossings

    slowness = (end - start) / jnp.maximum(size, 1e-12)
    # A window is half open, [start, end): a crossing at the very end is stamped a microsecond before it.
    latest = end - MICROSECOND
    first = jnp.clip(start + (contrast - offset) * slowness, start, latest)
    step = jnp.minimum(contrast * slowness, (latest - first) / jnp.maximum(crossings - 1, 1))
    count = crossings
    if config.refractory_ns > 0.0:
        refractory = refractory_s(config, faults)
        # Evenly spaced crossings give evenly spaced events: skip the first few, then take every stride-th.
        spacing = jnp.maximum(step, 1e-12)
        skipped = jnp.maximum(jnp.ceil((last_event + refractory - first) / spacing), 0.0)
        stride = jnp.maximum(jnp.ceil(refractory / spacing), 1.0)
        left = crossings - jnp.minimum(skipped, 1e9).astype(jnp.int32)
        count = jnp.where(left > 0, 1 + (left - 1) // jnp.minimum(stride, 1e9).astype(jnp.int32), 0)
        first = jnp.where(count > 0, first + skipped * step, start)
        step = jnp.where(count > 0, stride * step, step)
    last_event = jnp.where(count > 0, first + (count - 1) * step, last_event)
    polarity = jnp.where(count > 0, jnp.where(rising, 1, -1), 0).astype(jnp.int8)
    return (residual, last_event), EventField(count, polarity, first, step, 0.0)
