"""Random numbers from as few calls as may be: each call is its own small program on a CPU."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


def integers(key: Array, shape: tuple[int, ...], below: int | Array) -> Array:
    """Integers [*shape] int32, uniform over 0 .. `below` - 1 but for a share of `below` / 2^32.

    One draw of bits, where `jax.random.randint` makes four to be exactly uniform.

    Args:
        key: consumed.
        below: at least 1; broadcast against `shape`.
    """
    bits = jax.random.bits(key, shape, jnp.uint32)
    return (bits % jnp.asarray(below, jnp.uint32)).astype(jnp.int32)
