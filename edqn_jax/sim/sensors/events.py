"""Events from brightness frames: Eq. 1-5 of the paper, in its order, and what AirSim computes instead of Eq. 1 and 4.

`event_laws` applies them to the frames of a window.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import EventsConfig

AIRSIM_EPSILON = 0.001
"""What AirSim adds to the 8-bit grey value before the logarithm."""


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
