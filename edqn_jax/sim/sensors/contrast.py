"""The contrast of an episode's event sensor: log-brightness change per event, drawn anew and known to the networks.

A user knows the contrast of his camera, so a policy may, too. The thresholds of the law scale with it, and what the
encoder reads are log-brightness changes in units of `REFERENCE`, whatever the contrast; see `event_field.in_units`.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from edqn_jax.config import EventsConfig
from edqn_jax.keys import log_uniform

REFERENCE = 0.05
"""Contrast at which one event is one unit of what the encoder reads."""

MIDDLE, HALF_RANGE = 0.0775, 1.355
"""Contrast that the networks know as 0, and the range of its logarithm up to 1: from -1 at 0.02 to 1 at 0.3."""


def is_drawn(events: EventsConfig) -> bool:
    """Returns whether episodes have a contrast of their own; without one, thresholds are as configured."""
    return events.most_contrast > 0.0


def nominal_contrast(events: EventsConfig) -> float:
    """Returns the configured log-brightness change per event of the law; of `esim` that of an ON event."""
    return {"paper": events.tolerance, "airsim": events.airsim_tolerance, "esim": events.contrast_on}[events.law]


def sample_contrast(events: EventsConfig, key: Array) -> Array:
    """Returns an episode's contrast [], log-uniform between the least and the most; `key` is consumed."""
    return log_uniform(key, events.least_contrast, events.most_contrast)


def value_of(contrast: Array) -> Array:
    """Returns what the networks know of contrasts [...], of order 1.

    >>> print(jnp.round(value_of(jnp.array([0.02, 0.0775, 0.3])), 2))
    [-1.  0.  1.]
    """
    return jnp.log(contrast / MIDDLE) / HALF_RANGE


def contrast_of(value: Array) -> Array:
    """Returns the contrasts [...] that the networks know as these values, the inverse of `value_of`."""
    return MIDDLE * jnp.exp(HALF_RANGE * value)
