"""Random keys by purpose, and numbers that are drawn in several places."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

RUN = 0xED09_0000
"""Folded into the key of every run's seed. Roots that are folded with counters, such as those of the test worlds, never
reach it: these stay below 2^31. (`split(key, n)[i]` equals `fold_in(key, i)`.)"""

RANDOM_WORLDS = 2_024
"""Seed of the root of every random world's key."""

FAMILY_OF_WORLD = 1_000_003
"""Folded into the key of a world of a mixture to draw its family."""

MOTION_OF_WORLD = 7_000_003
"""Folded into the key of a world to draw what moves in it."""

LOOK_OF_WORLD = 8_000_009
"""Folded into the key of a world to draw its patterns and its light."""

CROSSING_OF_WORLD = 9_000_011
"""Folded into the key of a world to draw the missions of several drones in it."""

FILE_MISSIONS = 7_919
"""Seed of the root of the keys of evaluation missions in worlds from files."""


class RunStreams(NamedTuple):
    """Keys of a run's independent random streams; each is consumed once."""

    learning: Array
    """Parameters, environments and shards of the training state."""
    training_missions: Array
    validation_missions: Array
    flights: Array
    """Sensor noise of validation and evaluation flights."""


def run_streams(seed: int) -> RunStreams:
    """Returns the keys of a run with this seed; no other code derives keys from a run's seed."""
    root = jax.random.fold_in(jax.random.key(seed), RUN)
    return RunStreams(*jax.random.split(root, len(RunStreams._fields)))


def uniform_integers(key: Array, shape: tuple[int, ...], below: int | Array) -> Array:
    """Integers [*shape] int32, uniform over 0 .. `below` - 1 but for a share of `below` / 2^32.

    One draw of bits, where `jax.random.randint` makes four to be exactly uniform.

    Args:
        key: consumed.
        below: at least 1; broadcast against `shape`.
    """
    bits = jax.random.bits(key, shape, jnp.uint32)
    return (bits % jnp.asarray(below, jnp.uint32)).astype(jnp.int32)


def log_uniform(key: Array, least: float, most: float) -> Array:
    """Returns a number [] between both, its logarithm uniform; `key` is consumed."""
    return jnp.exp(jax.random.uniform(key, minval=math.log(least), maxval=math.log(most)))


def uniform_parts(key: Array, counts: Sequence[int]) -> list[Array]:
    """Returns as many uniform numbers in [0, 1) as each of the counts says, of one draw; `key` is consumed."""
    return jnp.split(jax.random.uniform(key, (sum(counts),)), list(itertools.accumulate(counts))[:-1])


def split_each(keys: Array, count: int) -> Array:
    """Splits each of `keys` [S], which are consumed, into `count`: [count, S]."""
    # As data, because JAX's check for keys that are used twice takes a transposed array of keys for used.
    data = jax.random.key_data(jax.vmap(lambda key: jax.random.split(key, count))(keys))
    return jax.random.wrap_key_data(jnp.swapaxes(data, 0, 1), impl=jax.random.key_impl(keys))
