"""Events from brightness frames: Eq. 1-5 of the paper, in its order, under three event laws.

Inside the compiled step events are never a list. Between two frames a pixel's events all have one polarity
and even spacing, so `EventField` holds them exactly; `to_stream` turns it into the `(t, x, y, p)` stream that
people exchange.

With noise a pixel may have events of both polarities between two frames: the rows of a field are then the ON events
of every frame pair and after them the OFF events, and in a row noise and signal of a pixel are one (`merge_fields`).

Shapes: T frames, F = T - 1 frame pairs (2 F rows in an `EventField` when noise events are on), H rows, W columns.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import NDArray

from edqn_jax.config import EventsConfig
from edqn_jax.sim.sensors import contrast, photoreceptor, poisson, sensor_pixels

STREAM_DTYPE = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
"""One event of a stream: time in microseconds, column, row, polarity in {-1, +1}."""

AIRSIM_EPSILON = 0.001
"""What AirSim adds to the 8-bit grey value before the logarithm."""

MIN_THRESHOLD_GAIN = 0.1
"""Mismatch never makes a threshold smaller than this share of the nominal one."""

LEAST_SHARE = 1e-3
"""Of its faults that an episode's sensor always has, so that their inverse is finite."""

NO_FRAME = -1.0
"""Luma of `EventMemory.frame` before there is one."""

MOST_OF_PIXEL = 1_000_000
"""Events of a pixel between two frames that are never reached, where many pixels have no other limit."""

MICROSECOND = 1e-6


@struct.dataclass
class EventField:
    """Events of one window, dense: in each row a pixel's events have one polarity and even spacing."""

    count: Array  # [F, H, W] int32, events of the pixel in this frame pair
    polarity: Array  # [F, H, W] int8 in {-1, 0, +1}; 0 where count is 0
    t_first: Array  # [F, H, W] float32 seconds from the start of the window
    t_step: Array  # [F, H, W] float32 seconds between a pixel's events
    window_s: float = struct.field(pytree_node=False)  # length of the window, seconds
    divides_window: bool = struct.field(pytree_node=False, default=False)
    """Whether `t_first` is 0 and `t_step` the window over `count` everywhere: Eq. 5 between one pair of frames."""
    with_noise: bool = struct.field(pytree_node=False, default=False)
    """Whether the rows are the ON events of every frame pair and then the OFF events, 2 F in all."""
    unit: Array | None = None
    """[] what an event counts for the encoder, see `in_units`; None is 1. With `sensor_pixels` counts are of all these
    pixels together."""


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


def log_brightness(config: EventsConfig, intensity: Array) -> Array:
    """Returns Eq. 1: `L = log(intensity + epsilon)` of linear luma `[...]` in [0, 1].

    The paper's logarithm has no epsilon; without one a black pixel would make infinitely many events.
    """
    return jnp.log(intensity + config.log_epsilon)


def airsim_log_brightness(intensity: Array) -> Array:
    """Returns Eq. 1 as AirSim computes it: the logarithm of the 8-bit grey value + 0.001, `[...]` float32.

    The 256 possible values are tabulated, so that no compiler's logarithm can move an event.
    """
    table = np.log(np.arange(256, dtype=np.float32) + np.float32(AIRSIM_EPSILON))
    grey = jnp.clip(jnp.round(intensity * 255.0), 0.0, 255.0).astype(jnp.int32)
    return jnp.asarray(table)[grey]


def event_polarity(change: Array, threshold: Array | float) -> Array:
    """Returns Eq. 2: +1 or -1 where the log brightness changed by more than the threshold, else 0. `[...]` int8.

    >>> print(event_polarity(jnp.array([0.12, -0.31, 0.01]), 0.05))
    [ 1 -1  0]
    """
    return jnp.where(jnp.abs(change) > threshold, jnp.sign(change), 0.0).astype(jnp.int8)


def max_events(config: EventsConfig, interval_s: float) -> int:
    """Returns Eq. 3: `N_max`, the most events that the refractory period allows between two frames."""
    if config.refractory_ns <= 0.0:
        return np.iinfo(np.int32).max
    interval_us = round(interval_s * 1e9) * 1e-3  # whole nanoseconds: no rounding error before int()
    return int(interval_us / (config.refractory_ns * 1e-3))


def event_count(change: Array, tolerance: Array | float, limit: Array | int) -> Array:
    """Returns Eq. 4: `N_e = min(N_max, floor(|change| / TOL))`, `[...]` int32.

    >>> print(event_count(jnp.array([0.12, -0.31, 0.01]), 0.05, 5))
    [2 5 0]
    """
    return jnp.minimum(jnp.floor(jnp.abs(change) / tolerance).astype(jnp.int32), limit)


def airsim_count(before: Array, after: Array, tolerance: Array | float, limit: Array | int) -> Array:
    """Returns AirSim's number of events: `floor(|change| / TOL) - 1`, `[...]`, none up to twice the tolerance.

    It counts from the first crossing rather than to it; the float32 rounding of that crossing is kept.
    """
    sign = jnp.sign(after - before)
    crossing = before + sign * tolerance
    beyond = (after - crossing) * sign
    count = jnp.where(beyond > 0.0, jnp.floor(beyond / tolerance), 0.0).astype(jnp.int32)
    return jnp.minimum(count, limit)


def event_times(count: Array, starts: Array, intervals: Array) -> tuple[Array, Array]:
    """Returns Eq. 5: `t_k = t_prev + k dT / N_e`, k = 0 .. N_e - 1, as `(t_first, t_step)` `[F, H, W]`, seconds."""
    return jnp.broadcast_to(starts, count.shape), intervals / jnp.maximum(count, 1).astype(jnp.float32)


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
    contrast_on, contrast_off = _thresholds(gain, config.contrast_on, config.contrast_off)
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


def in_units(field: EventField) -> Array:
    """Returns the counts [..., F, H, W] float32 as encoders read them.

    Where the contrast is drawn, they are log-brightness changes over `contrast.REFERENCE`; of sensors with several
    pixels under one of ours they are the mean of these.
    """
    counts = field.count.astype(jnp.float32)
    return counts if field.unit is None else counts * field.unit[..., None, None, None]


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


def event_image(field: EventField) -> Array:
    """Returns ON minus OFF events per pixel over the window, `[H, W]` int32."""
    return jnp.sum(field.count * field.polarity, axis=-3)


def image_in_units(field: EventField) -> Array:
    """Returns ON minus OFF events per pixel over the window `[..., H, W]`, as encoders read them, see `in_units`."""
    return event_image(field) if field.unit is None else jnp.sum(in_units(field) * field.polarity, axis=-3)


def random_field(config: EventsConfig, height: int, width: int, rng: np.random.Generator) -> EventField:
    """Returns a field [F, H, W] of 0 to 2 events per pixel and frame pair, all at time 0; for measurements."""
    shape = (max(len(config.frame_times_s) - 1, 1), height, width)
    count, times = jnp.asarray(rng.integers(0, 3, shape), jnp.int32), jnp.zeros(shape)
    window_s = config.frame_times_s[-1] - config.frame_times_s[0]
    even = divides_window(config, len(config.frame_times_s))
    unit = jnp.ones(()) if is_scaled(config) else None
    return EventField(count, jnp.sign(count).astype(jnp.int8), times, times, window_s, even, unit=unit)


def event_picture(image: NDArray, background: str = "white") -> NDArray[np.uint8]:
    """Returns a red-blue picture of a signed event image (Fig. 6): `[H, W]` to `[H, W, 3]`, ON red and OFF blue.

    One event already has half the colour's strength; more events approach it.

    Raises:
        ValueError: if the background is neither `white` nor `black`.
    """
    if background not in ("white", "black"):
        raise ValueError(f"the background is 'white' or 'black', not '{background}'")
    image = np.asarray(image).astype(np.float64)
    paper = np.full(3, 255.0 if background == "white" else 0.0)
    ink = np.where(image[..., None] > 0, np.array([230.0, 30.0, 30.0]), np.array([40.0, 70.0, 240.0]))
    strength = np.where(image == 0, 0.0, 1.0 - 0.5 * 0.5 ** (np.abs(image) - 1))[..., None]
    return np.rint(paper + strength * (ink - paper)).astype(np.uint8)


def to_stream(field: EventField, window_start_us: int = 0) -> NDArray:
    """Returns the stream of a field: [N] of `STREAM_DTYPE`, sorted by time (host side, NumPy).

    Times are rounded to the microsecond. Ties keep the order row, column.
    """
    count = np.asarray(field.count)
    row, y, x = np.nonzero(count)
    number = count[row, y, x]
    first = np.asarray(field.t_first, np.float64)[row, y, x]
    step = np.asarray(field.t_step, np.float64)[row, y, x]
    pixel = np.repeat(np.arange(number.size), number)
    index = np.arange(pixel.size) - (np.cumsum(number) - number)[pixel]
    stream = np.empty(pixel.size, STREAM_DTYPE)
    stream["t"] = window_start_us + np.rint((first[pixel] + index * step[pixel]) * 1e6).astype(np.int64)
    stream["x"], stream["y"] = x[pixel], y[pixel]
    stream["p"] = np.asarray(field.polarity)[row, y, x][pixel]
    return stream[np.argsort(stream["t"], kind="stable")]


def _thresholds(gain: Array | None, on: float, off: float) -> tuple[Array, Array]:
    """Returns ON and OFF thresholds, each a scalar or `[H, W]` with the sensor's mismatch."""
    if gain is None:
        return jnp.float32(on), jnp.float32(off)
    return gain[0] * on, gain[1] * off


def _refractory_s(config: EventsConfig, faults: Array | None) -> Array | float:
    """Returns the least seconds between two events, [] or a number; of many pixels the mean of these."""
    period = config.refractory_ns * 1e-9
    return period if faults is None and config.sensor_pixels == 1 else period * _or_1(faults) / config.sensor_pixels


def _limits(config: EventsConfig, times: NDArray, faults: Array | None) -> Array:
    """Returns the most events of all sensor pixels between two frames [F, 1, 1] int32."""
    if faults is None and config.sensor_pixels == 1:
        return jnp.array([max_events(config, dt) for dt in np.diff(times)], jnp.int32)[:, None, None]
    if config.refractory_ns <= 0.0:
        return jnp.full((len(times) - 1, 1, 1), config.sensor_pixels * MOST_OF_PIXEL, jnp.int32)
    # Rounding must not take away the event that just fits.
    whole = jnp.floor(jnp.asarray(np.diff(times) / (config.refractory_ns * 1e-9)) / _or_1(faults) + 1e-4)
    return config.sensor_pixels * jnp.minimum(whole, MOST_OF_PIXEL).astype(jnp.int32)[:, None, None]


def _many_pixels(
    config: EventsConfig, memory: EventMemory, level: Array, times: NDArray, key: Array
) -> tuple[EventField, EventMemory]:
    """Returns the events of `sensor_pixels` pixels together under each of ours, evenly spaced between two frames."""
    intervals, change = np.diff(times), jnp.diff(level, axis=0)
    if config.law == "esim":
        on, off = _thresholds(memory.gain, config.contrast_on, config.contrast_off)
        assert memory.residual is not None

        def pair(residual: Array, change: Array) -> tuple[Array, Array]:
            expected, residual = sensor_pixels.follow(residual, change, on, off)
            return residual, expected

        residual, signed = jax.lax.scan(pair, memory.residual, change, unroll=min(len(intervals), 2))
        memory = dataclasses.replace(memory, residual=residual)
    else:
        on, off = _thresholds(memory.gain, config.tolerance, config.tolerance)
        signed = change / jnp.where(change > 0.0, on, off)
    drawn = sensor_pixels.count_all(jnp.abs(signed), config.sensor_pixels, key)
    count = jnp.minimum(drawn, _limits(config, times, memory.faults))
    starts = jnp.asarray(times[:-1, None, None], jnp.float32)
    t_first, t_step = event_times(count, starts, jnp.asarray(intervals[:, None, None], jnp.float32))
    polarity = jnp.where(count > 0, jnp.sign(signed), 0.0).astype(jnp.int8)
    return EventField(count, polarity, t_first, t_step, 0.0), memory


def _frame_pairs(config: EventsConfig, memory: EventMemory, level: Array, times: NDArray) -> EventField:
    """Returns the events of the memoryless laws, `paper` and `airsim`."""
    intervals, gain = np.diff(times), memory.gain
    limit = _limits(config, times, memory.faults)
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
    contrasts = _thresholds(memory.gain, config.contrast_on, config.contrast_off)

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
        refractory = _refractory_s(config, faults)
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


def has_noise(config: EventsConfig) -> bool:
    """Returns whether pixels fire without a change of brightness."""
    return config.leak_rate_hz > 0.0 or config.shot_rate_hz > 0.0 or config.hot_pixel_fraction > 0.0


def noise_events(
    config: EventsConfig,
    hot: Array | None,
    signal: Array,
    times: NDArray,
    key: Array,
    shot: Array | float = 1.0,
    faults: Array | None = None,
) -> EventField:
    """Returns the noise events of every frame pair, ON and then OFF [2 F, H, W]: Poisson counts, evenly spaced.

    Leak and hot pixels make ON events, shot noise either. A pixel's refractory period leaves it `max_events` between
    two frames, of which the signal's come first. Noise does not change esim's reference.

    Args:
        hot: [H, W] bool, hot pixels; None where there are none.
        signal: [F, H, W] int32, events that the pixels have without noise.
        times: [T] seconds of the frames.
        key: consumed.
        shot: [F, H, W] or scalar factor on the rate of shot noise.
        faults: [] share of its faults that the sensor has; None is all.
    """
    key_count, key_phase = jax.random.split(key)
    pairs = signal.shape[0]
    firing = 0.0 if hot is None else config.hot_pixel_rate_hz * hot
    all_pixels = config.sensor_pixels if faults is None else config.sensor_pixels * faults
    off = 0.5 * config.shot_rate_hz * shot * all_pixels
    on = config.leak_rate_hz * all_pixels + off + firing
    rates = jnp.stack([jnp.broadcast_to(rate, signal.shape) for rate in (on, off)])
    lengths = np.diff(times)
    intervals = jnp.asarray(lengths, jnp.float32)[:, None, None]
    if faults is None and config.sensor_pixels == 1:
        counts = poisson.sample_capped(key_count, rates * intervals, max(max_events(config, dt) for dt in lengths))
    else:
        counts = poisson.sample_counts(key_count, rates * intervals)
    limit = _limits(config, times, faults)
    room = jnp.maximum(limit - signal, 0)
    on = jnp.minimum(counts[0], room)
    count = jnp.concatenate([on, jnp.minimum(counts[1], room - on)])
    intervals, starts = jnp.tile(intervals, (2, 1, 1)), jnp.tile(jnp.asarray(times[:-1], jnp.float32), 2)[:, None, None]
    step = intervals / jnp.maximum(count, 1)
    # A window is half open; float32 may round a phase of nearly 1 up to its end.
    phase = jnp.minimum(jax.random.uniform(key_phase, count.shape) * step, intervals - (count - 1) * step - MICROSECOND)
    sign = jnp.repeat(jnp.array([1, -1], jnp.int8), pairs)[:, None, None]
    return EventField(count, jnp.where(count > 0, sign, 0).astype(jnp.int8), starts + phase, step, 0.0)


def split_polarity(field: EventField) -> EventField:
    """Returns a field [F, H, W] as the ON events of its rows and then the OFF events, [2 F, H, W]."""
    signs = (field.polarity > 0, field.polarity < 0)
    twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), field)
    of_sign = jnp.concatenate(signs)
    return dataclasses.replace(
        twice, count=jnp.where(of_sign, twice.count, 0), polarity=jnp.where(of_sign, twice.polarity, 0).astype(jnp.int8)
    )


def merge_fields(
    config: EventsConfig, one: EventField, other: EventField, times: NDArray, faults: Array | None = None
) -> EventField:
    """Returns the events of two fields [2 F, H, W] of `split_polarity` in one: the source field of an event is not
    kept.

    Counts are added. Where both have events in a row, they are spaced evenly from the first to the last of all, at
    least a refractory period apart.

    Args:
        times: [T] seconds of the frames.
        faults: [] share of its faults that the sensor has; None is all.
    """
    count = one.count + other.count
    fields = (one, other)
    firsts = [jnp.where(field.count > 0, field.t_first, jnp.inf) for field in fields]
    lasts = [jnp.where(field.count > 0, field.t_first + (field.count - 1) * field.t_step, 0.0) for field in fields]
    first, last = jnp.minimum(*firsts), jnp.maximum(*lasts)
    gaps = jnp.maximum(count - 1, 1)
    step = jnp.maximum((last - first) / gaps, _refractory_s(config, faults))
    starts, ends = (jnp.tile(jnp.asarray(t, jnp.float32), 2)[:, None, None] for t in (times[:-1], times[1:]))
    first = jnp.clip(first, starts, jnp.maximum(ends - MICROSECOND - gaps * step, starts))
    alone, still = other.count == 0, one.count == 0
    return dataclasses.replace(
        one,
        count=count,
        polarity=jnp.where(alone, one.polarity, other.polarity),
        t_first=jnp.where(alone, one.t_first, jnp.where(still, other.t_first, first)),
        t_step=jnp.where(alone, one.t_step, jnp.where(still, other.t_step, step)),
    )
