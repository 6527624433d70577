"""JAX's random bits on CPUs by one call in C, in programs that draw a few numbers in many places.

JAX lowers Threefry on CPUs to a loop of five turns with a dozen operations each. Of a hundred numbers, starting these
takes far longer than their arithmetic, and each loop is compiled anew. The bits are the same.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.random import threefry2x32_p
from jax.interpreters import mlir

from edqn_jax.native.build import ensure_registered
from edqn_jax.native.own_programs import is_own_program

SOURCE = Path(__file__).with_suffix(".c")

TARGET = "edqn_threefry"

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = 0x1BD11BDA


@functools.cache
def draw_own_in_c() -> None:
    """Has `jax.random` draw in C in the package's own programs for CPUs, see `own_program`.

    JAX's lowering of Threefry on CPUs is replaced in this process. Others' programs draw in a loop like JAX's, and so
    does what cannot be C: where there is no compiler, and arrays that XLA may spread over several devices.
    """
    mlir.register_lowering(threefry2x32_p, _lower, platform="cpu")


def is_available() -> bool:
    """Returns whether the library is loaded and registered, which the first call does."""
    return ensure_registered(SOURCE, (TARGET,))


def _lower(context: Any, *arrays: Any) -> Any:
    in_c = is_own_program() and _is_on_one_device(context) and is_available()
    return mlir.lower_fun(draw_in_c if in_c else draw_in_loop, multiple_results=True)(context, *arrays)


def _is_on_one_device(context: Any) -> bool:
    """Returns whether each device is told apart where a program is lowered: there is one, or `shard_map` parted them.

    Args:
        context: of the lowering. Of what a later JAX calls otherwise, the answer is no.
    """
    axes: Any = getattr(getattr(context, "module_context", None), "axis_context", None)
    if hasattr(axes, "manual_axes") and hasattr(axes, "mesh"):
        return axes.manual_axes >= set(axes.mesh.axis_names)
    return getattr(axes, "num_devices", None) == 1


def draw_in_c(*arrays: Array) -> tuple[Array, Array]:
    """Returns both words of Threefry's bits, uint32 [...], of both words of keys and counts, which are broadcast."""
    arrays = tuple(jnp.broadcast_arrays(*arrays))
    bits = jax.ShapeDtypeStruct(arrays[0].shape, jnp.uint32)
    first, second = jax.ffi.ffi_call(TARGET, (bits, bits))(*arrays)
    return first, second


def draw_in_loop(*arrays: Array) -> tuple[Array, Array]:
    """Returns the same as `draw_in_c`, as JAX lowers it: a loop with four rounds a turn, so that little is compiled."""
    first, second, x, y = jnp.broadcast_arrays(*arrays)
    third = first ^ second ^ np.uint32(PARITY)
    rotations = tuple(jnp.asarray(row, jnp.uint32) for row in ROTATIONS)

    def turn(number: Array, now: Any) -> Any:
        (x, y), (key, following, last), (these, others) = now
        for rotation in these:
            x = x + y
            y = x ^ ((y << rotation) | (y >> (np.uint32(32) - rotation)))
        x, y = x + key, y + following + jnp.uint32(number + 1)
        return (x, y), (following, last, key), (others, these)

    return lax.fori_loop(0, 5, turn, ((x + first, y + second), (second, third, first), rotations))[0]
