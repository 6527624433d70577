"""Many pixels of a real sensor under one of ours: n pixels that see the same brightness and differ by chance.

Each has a threshold of its own, and a reference level that lies anywhere between two of its events. So the events of
all add up to n times the change over the threshold, without a dead band, and only their dither is left: of a change of
k + f thresholds n k events and a binomial share f of n more. That is what is drawn here, at the cost of one number for
a pixel; n pixels, one by one, are in the tests.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


def mean_sensitivity(mismatch: Array | float) -> Array | float:
    """Returns the mean of 1 / threshold over pixels whose thresholds are normal about 1, to 1 % up to 0.3.

    >>> round(mean_sensitivity(0.25), 3)
    1.078
    """
    square = mismatch * mismatch
    return 1.0 + square + 3.0 * square * square + 15.0 * square * square * square


def count_all(expected: Array, pixels: int, key: Array) -> Array:
    """Returns the events [...] int32 of `pixels` pixels together that expect so many each; `key` is consumed.

    The binomial distribution of those that fire once more is taken for a normal one of its variance.
    """
    part = expected - jnp.floor(expected)
    spread = jnp.sqrt(pixels * part * (1.0 - part))
    drawn = jnp.round(pixels * expected + spread * jax.random.normal(key, expected.shape))
    low, high = pixels * jnp.floor(expected), pixels * jnp.ceil(expected)
    return jnp.clip(drawn, low, high).astype(jnp.int32)


def follow(residual: Array, change: Array, on: Array, off: Array) -> tuple[Array, Array]:
    """Returns the change beyond the dead band of pixels with memory, [...] in thresholds, ON positive, and the
    residual.

    Long after brightness began to rise, references lie anywhere within a threshold below it: it has to fall by one
    threshold before the first OFF event, and from there on every pixel's turn comes evenly. So the mean of many pixels
    has backlash, and no steps.

    Args:
        residual: [...] log brightness above the lower end of the dead band, 0 to (on + off) / 2.
        change: [...] of log brightness.
        on, off: thresholds, which broadcast.
    """
    moved, band = residual + change, 0.5 * (on + off)
    beyond = jnp.maximum(moved - band, 0.0) / on - jnp.maximum(-moved, 0.0) / off
    return beyond, jnp.clip(moved, 0.0, band)
