"""How much light falls on an episode's world: one illuminance, drawn anew for each episode.

Brightness in this project is a share of the brightest, whatever the light; these are the lux of a surface that faces
the sun. What they do is the sensor's: `photoreceptor` for events, `exposure` for frames.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from edqn_jax.config import LightConfig
from edqn_jax.keys import log_uniform

MIDDLE_LUX, HALF_DECADES = 10.0**1.5, 2.5
"""Illuminance that the networks know as 0, and its decades up to 1: from -1 at 0.1 lux to 1 at 10 000."""


def is_on(light: LightConfig) -> bool:
    """Returns whether episodes have an illuminance; without one, no sensor knows of light."""
    return light.most_lux > 0.0


def sample_illuminance(light: LightConfig, key: Array) -> Array:
    """Returns an episode's illuminance [] lux, log-uniform between the least and the most; `key` is consumed."""
    return log_uniform(key, light.least_lux, light.most_lux)


def value_of(lux: Array) -> Array:
    """Returns what the networks know of illuminances [...] lux, of order 1.

    >>> print(jnp.round(value_of(jnp.array([0.1, 31.623, 10_000.0])), 2))
    [-1.  0.  1.]
    """
    return jnp.log10(lux / MIDDLE_LUX) / HALF_DECADES
