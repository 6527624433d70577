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

MOST_SMALL = 4.0
"""Largest mean of which Poisson counts are drawn by inversion; larger ones are nearly normal."""

TINY = 1e-30
"""Probability that is none."""

TERMS = 18
"""Of the inversion: a count of `MOST_SMALL` is larger in one of 10^7."""


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


def sample_poisson(key: Array, mean: Array) -> Array:
    """Returns Poisson counts of means [...], int32: by inversion up to `MOST_SMALL`, beyond normal with their skewness.

    At a small part of the cost of `jax.random.poisson`, whose loops run until the last of all is found.
    """
    few, many = jax.random.split(key)
    small = jnp.minimum(mean, MOST_SMALL)
    uniforms = jax.random.uniform(few, mean.shape)
    normal = jax.random.normal(many, mean.shape)
    large = jnp.maximum(jnp.round(mean + jnp.sqrt(mean) * normal + (normal * normal - 1.0) / 6.0), 0.0)

    def term(number: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        count, probability, below = carry
        count = count + jnp.where((mean <= MOST_SMALL) & (uniforms >= below), 1.0, 0.0)
        # At least that of a normal number, since a CPU is slow with denormal ones.
        probability = jnp.maximum(probability * small / (number + 1.0), TINY)
        return count, probability, below + probability

    # A loop, since XLA draws what is not one again for each use of the counts, at ten times the cost on a CPU.
    none = jnp.exp(-small)
    first = jnp.where(mean > MOST_SMALL, large, 0.0), none, none
    return jax.lax.fori_loop(0, TERMS, term, first, unroll=6)[0].astype(jnp.int32)
