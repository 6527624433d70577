"""Poisson counts at a small part of the cost of `jax.random.poisson`: of noise events, and of pixels that are hot."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

MAX_BY_INVERSION = 16
"""Largest cap for which `sample_capped` draws by inversion."""

MOST_SMALL = 4.0
"""Largest mean of which Poisson counts are drawn by inversion; larger ones are nearly normal."""

TINY = 1e-30
"""Probability that is none."""

TERMS = 18
"""Of the inversion: a count of `MOST_SMALL` is larger in one of 10^7."""


def sample_capped(key: Array, mean: Array, most: int) -> Array:
    """Returns Poisson counts of a mean [...], int32, to probabilities of 2^-23.

    For `most` <= `MAX_BY_INVERSION` counts are capped at `most`, otherwise they are not capped. Capped ones, as
    refractory pixels have, come from one uniform number by inversion, at a small part of the cost of
    `jax.random.poisson`.
    """
    if most > MAX_BY_INVERSION:
        return jax.random.poisson(key, mean, mean.shape, dtype=jnp.int32)
    uniforms = jax.random.uniform(key, mean.shape)
    probability = below = jnp.exp(-mean)
    count = jnp.zeros(mean.shape, jnp.int32)
    for number in range(most):
        # Above the median, what is less probable than a step of `uniforms` is left out: float32's sum may end below 1.
        possible = (below < 0.5) | (probability > 2.0**-24)
        count = count + ((uniforms >= below) & possible)
        probability = probability * mean / (number + 1)
        below = below + probability
    return count


def sample_counts(key: Array, mean: Array) -> Array:
    """Returns Poisson counts of means [...], int32: by inversion up to `MOST_SMALL`, beyond normal with their skewness.

    At a small part of the cost of `jax.random.poisson`, whose loops run until the last of all is found. For means of
    which no cap is known while tracing; `sample_capped` is quicker where one is.
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
