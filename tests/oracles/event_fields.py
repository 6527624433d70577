"""Fields of events from what is known of them otherwise: a stream, or signed counts."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from edqn_jax.config import EventsConfig
from edqn_jax.sim.sensors.event_field import MICROSECOND, EventField, event_image
from edqn_jax.sim.sensors.events import event_times


def signed_count(field: EventField) -> Array:
    """Returns ON minus OFF events per pixel over the window, clipped to `[H, W]` int8."""
    return jnp.clip(event_image(field), -127, 127).astype(jnp.int8)


def field_of_counts(config: EventsConfig, counts: Array) -> EventField:
    """Returns the field of a stored `[H, W]` signed count; exact for two frames under `paper` or `airsim`."""
    window_s = config.frame_times_s[-1] - config.frame_times_s[0]
    count = jnp.abs(counts.astype(jnp.int32))[None]
    t_first, t_step = event_times(count, jnp.float32(0.0), jnp.float32(window_s))
    return EventField(count, jnp.sign(counts).astype(jnp.int8)[None], t_first, t_step, window_s, divides_window=True)


def collect(
    stream: NDArray, frame_times: Sequence[float], height: int, width: int, window_start_us: int = 0
) -> EventField:
    """Returns the field of a stream [N]: the inverse of `expand` for a field without noise (host side, NumPy).

    Lossless in this sense: `expand(collect(s)) == s` event by event, and `collect(expand(f))` has f's counts
    and polarities exactly and every event within a microsecond. Times come back as float64.

    Raises:
        ValueError: if a pixel has events of both polarities, or unevenly spaced ones, between two frames.
    """
    edges = np.rint((np.asarray(frame_times, np.float64) - frame_times[0]) * 1e6).astype(np.int64)
    shape = (len(edges) - 1, height, width)
    t = stream["t"] - window_start_us
    row = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, shape[0] - 1)
    cell = np.ravel_multi_index((row, stream["y"].astype(np.int64), stream["x"].astype(np.int64)), shape)
    order = np.lexsort((t, cell))
    cell, t, sign = cell[order], t[order].astype(np.float64), stream["p"][order]
    cells, begin, number = np.unique(cell, return_index=True, return_counts=True)
    pixel = np.repeat(np.arange(cells.size), number)
    index = np.arange(t.size) - begin[pixel]
    first, step, width_us = _line_through(t, index, pixel, begin, number)
    if np.any(sign != sign[begin][pixel]) or np.any(width_us >= 1.0 + 1e-6):
        raise ValueError(
            "the stream is not a noiseless event field: between two frames a pixel has events of both "
            "polarities or unevenly spaced ones; each pixel must have one polarity and even spacing"
        )
    count, polarity = np.zeros(shape, np.int32), np.zeros(shape, np.int8)
    t_first, t_step = np.zeros(shape), np.zeros(shape)
    count.flat[cells], polarity.flat[cells] = number, sign[begin]
    t_first.flat[cells], t_step.flat[cells] = first * MICROSECOND, step * MICROSECOND
    return EventField(count, polarity, t_first, t_step, float(frame_times[-1] - frame_times[0]))  # type: ignore


def _line_through(
    t: NDArray, index: NDArray, pixel: NDArray, begin: NDArray, number: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Returns, per pixel, the line `first + index * step` whose largest distance from the times `t` is least.

    The width of the strip around the times is convex in the slope, so a ternary search finds it. Times that
    are a rounded line are in a strip narrower than one microsecond, and its middle rounds to them again.
    """
    if t.size == 0:
        return np.zeros(0), np.zeros(0), np.zeros(0)

    def strip(slope: NDArray) -> tuple[NDArray, NDArray]:
        height = t - index * slope[pixel]
        return np.minimum.reduceat(height, begin), np.maximum.reduceat(height, begin)

    gaps = np.maximum(number - 1, 1)
    mean = (t[begin + number - 1] - t[begin]) / gaps
    low, high = np.where(number > 2, mean - 1.0 / gaps, mean), np.where(number > 2, mean + 1.0 / gaps, mean)
    for _ in range(90):
        left, right = low + (high - low) / 3.0, high - (high - low) / 3.0
        (left_min, left_max), (right_min, right_max) = strip(left), strip(right)
        better = left_max - left_min <= right_max - right_min
        low, high = np.where(better, low, left), np.where(better, right, high)
    slope = (low + high) / 2.0
    lower, upper = strip(slope)
    return (lower + upper) / 2.0, slope, upper - lower
