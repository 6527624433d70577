"""Events that pixels make without a change of brightness, and how they are merged with those of a change.

Shapes: T frames, F = T - 1 frame pairs, H rows, W columns.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from edqn_jax.config import EventsConfig
from edqn_jax.sim.sensors import poisson
from edqn_jax.sim.sensors.event_field import MICROSECOND, EventField
from edqn_jax.sim.sensors.event_memory import limits, refractory_s
from edqn_jax.sim.sensors.events import max_events


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
    limit = limits(config, times, faults)
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
    step = jnp.maximum((last - first) / gaps, refractory_s(config, faults))
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
