"""How much light falls on an episode's world: one illuminance, drawn anew for each episode.

Brightness in this project is a share of the brightest, whatever the light; these are the lux of a surface that faces
the sun. What they do is the sensor's: `photoreceptor` for events, `exposure` for frames.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import Array

from edqn_jax.config import LightConfig


def is_on(light: LightConfig) -> bool:
    """Returns whether episodes have an illuminance; without one, no sensor knows of light."""
    return light.most_lux > 0.0


def sample_illuminance(light: LightConfig, key: Array) -> Array:
    """Returns an episode's illuminance [] lux, log-uniform between the least and the most; `key` is consumed."""
    least, most = math.log(light.least_lux), math.log(light.most_lux)
    return jnp.exp(jax.random.uniform(key, minval=least, maxval=most))
