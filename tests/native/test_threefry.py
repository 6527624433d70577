"""JAX's random bits, drawn in C in programs of ours."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from edqn_jax.native.own_programs import own_program
from edqn_jax.native.threefry import TARGET, draw_in_c, draw_in_loop, draw_own_in_c, is_available

HAS_COMPILER = shutil.which("cc") is not None
draw_own_in_c()
MESH = Mesh(np.asarray(jax.devices()[:2]), ("d",))


def lowered(function: Callable[..., Any], *arguments: Any, in_c: bool) -> jax.stages.Lowered:
    program = jax.jit(lambda *arguments: function(*arguments))  # a new one: what is lowered once is kept
    if not in_c:
        return program.lower(*arguments)
    with own_program():
        return program.lower(*arguments)


@pytest.mark.parametrize("draw", [draw_in_loop, *([draw_in_c] if HAS_COMPILER else [])])
def test_bits_are_those_that_the_authors_publish(draw: Callable[..., Any]) -> None:
    assert is_available() is HAS_COMPILER
    # Of the file kat_vectors of Random123: words of counts, of keys and of bits, 20 rounds.
    vectors = np.array(
        [
            [0x00000000, 0x00000000, 0x00000000, 0x00000000, 0x6B200159, 0x99BA4EFE],
            [0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0x1CB996FC, 0xBB002BE7],
            [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344, 0xC4923A9C, 0x483DF7A0],
        ],
        np.uint32,
    )
    found = jax.jit(draw)(*vectors.T[[2, 3, 0, 1]])
    np.testing.assert_array_equal(np.stack(found, axis=-1), vectors[:, 4:])


def numbers_of(key: jax.Array) -> Any:
    first, second, third, fourth = jax.random.split(key, 4)
    return (
        jax.random.bits(first, (3, 5)),
        jax.random.normal(second, (7,)),
        jax.random.randint(third, (), 0, 1000),
        jax.random.key_data(jax.random.fold_in(fourth, 3)),
        jax.random.bits(fourth, (0,)),
        jax.random.bits(fourth, (9,), jnp.uint8),
    )


@pytest.mark.parametrize("times_mapped", [0, 1, 2])
def test_what_is_drawn_is_what_jax_draws_to_the_bit(times_mapped: int) -> None:
    function, keys = numbers_of, jax.random.key(0)
    for _ in range(times_mapped):
        function, keys = jax.vmap(function), jax.random.split(jax.random.key(1), (3, *keys.shape))
    programs = [lowered(function, keys, in_c=in_c) for in_c in (True, False)]
    assert [TARGET in program.as_text() for program in programs] == [HAS_COMPILER, False]
    jax.tree.map(np.testing.assert_array_equal, *(program.compile()(keys) for program in programs))


def test_devices_of_shard_map_draw_in_c_each_and_what_the_compiler_spreads_does_not() -> None:
    keys = jax.device_put(jax.random.split(jax.random.key(2), 4), NamedSharding(MESH, PartitionSpec("d")))
    spec = PartitionSpec("d")
    each = jax.shard_map(jax.vmap(numbers_of), mesh=MESH, in_specs=spec, out_specs=spec, check_vma=False)
    parted, spread = lowered(each, keys, in_c=True), lowered(jax.vmap(numbers_of), keys, in_c=True)
    assert (TARGET in parted.as_text()) is HAS_COMPILER
    assert TARGET not in spread.as_text()
    jax.tree.map(np.testing.assert_array_equal, parted.compile()(keys), spread.compile()(keys))


def test_programs_that_are_lowered_elsewhere_can_be_exported() -> None:
    exported = jax.export.export(jax.jit(lambda key: jax.random.normal(key, (3,))))(jax.random.key(0))
    np.testing.assert_array_equal(exported.call(jax.random.key(0)), jax.random.normal(jax.random.key(0), (3,)))
