"""Products in bfloat16, in C where that is faster, else by XLA, against rounded factors in double precision."""

from __future__ import annotations

import shutil
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import AgentConfig
from edqn_jax.learn.perception.layers import matmul
from edqn_jax.learn.qnetwork import init_q, q_values
from edqn_jax.native import products
from edqn_jax.native.build import ensure_registered
from edqn_jax.native.products import LEAST_SIDE, are_rounded, in_precision, is_available, is_faster_on, rounded_matmul
from edqn_jax.native.shipped import processor_flags
from tests.oracles.rounded_products import product, to_bfloat16

SHAPES = [(32, 32, 32), (33, 47, 65), (64, 1024, 32), (48, 1025, 49), (257, 96, 112), (32, 2500, 80)]


def numbers(seed: int, *shape: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.normal(size=shape) * np.exp(rng.normal(size=shape))).astype(np.float32)


def assert_close(found: Any, left: Any, right: Any) -> None:
    """Holds a product against that of rounded factors in double precision; sums in float32 round, too."""
    size = np.abs(to_bfloat16(left)) @ np.abs(to_bfloat16(right))
    assert np.all(np.abs(np.asarray(found, np.float64) - product(left, right)) <= 2e-6 * size)


@pytest.mark.parametrize(("rows", "depth", "columns"), SHAPES)
def test_products_and_their_gradients_are_those_of_rounded_factors(rows: int, depth: int, columns: int) -> None:
    x, kernel = numbers(0, rows, depth), numbers(1, depth, columns)
    change = numbers(2, rows, columns)
    found, gradient = jax.vjp(jax.jit(rounded_matmul), x, kernel)
    of_rows, of_kernel = gradient(change)
    assert_close(found, x, kernel)
    assert_close(of_rows, change, kernel.T)
    assert_close(of_kernel, x.T, change)
    assert not np.allclose(found, x @ kernel, rtol=1e-5, atol=0.0)  # which rounds nothing


@pytest.mark.parametrize(("rows", "depth", "columns"), SHAPES)
def test_processors_without_amx_multiply_alike(
    monkeypatch: pytest.MonkeyPatch, rows: int, depth: int, columns: int
) -> None:
    """By AVX-512's dot products, which a processor with AMX has as well."""
    targets = tuple(f"dots_{target}" for target in products.TARGETS)
    definitions = ("WITHOUT_AMX=1", *map("=".join, zip(products.TARGETS, targets, strict=True)))
    has = shutil.which("cc") is not None and {"avx512_bf16", "avx512bw"} <= processor_flags()
    assert ensure_registered(products.SOURCE, targets, definitions) is has
    if has:
        monkeypatch.setattr(products, "TARGETS", targets)
        monkeypatch.setattr(products, "is_available", lambda: True)
        x, kernel, change = numbers(0, rows, depth), numbers(1, depth, columns), numbers(2, rows, columns)
        found, gradient = jax.vjp(rounded_matmul, x, kernel)
        for each, *factors in zip(
            (found, *gradient(change)), (x, change, x.T), (kernel, kernel.T, change), strict=True
        ):
            assert_close(each, *factors)


def test_rows_in_several_dimensions_and_mapped_kernels_are_multiplied_one_by_one() -> None:
    x, kernels = numbers(0, 3, 5, 8, 40), numbers(1, 3, 40, 50)
    found = jax.jit(jax.vmap(rounded_matmul))(x, kernels)
    for each, rows, kernel in zip(found, x, kernels, strict=True):
        assert_close(each.reshape(-1, 50), rows.reshape(-1, 40), kernel)
    shared = jax.vmap(rounded_matmul, in_axes=(0, None))(x, kernels[0])
    np.testing.assert_array_equal(shared, rounded_matmul(x, kernels[0]))


def test_narrow_products_are_not_rounded() -> None:
    narrow = LEAST_SIDE - 1
    for rows, depth, columns in ((narrow, 64, 64), (64, narrow, 64), (64, 64, narrow)):
        x, kernel = numbers(0, rows, depth), numbers(1, depth, columns)
        np.testing.assert_allclose(rounded_matmul(x, kernel), x @ kernel, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.int32])
def test_numbers_of_other_types_are_multiplied_as_they_are(dtype: Any) -> None:
    x = jnp.ones((32, 32), dtype)
    np.testing.assert_array_equal(np.asarray(rounded_matmul(x, x), np.float32), np.full((32, 32), 32.0))


@pytest.mark.parametrize(
    ("flags", "faster"),
    [
        ("avx512f avx512_bf16 amx_bf16 amx_tile", True),  # a Xeon from 2023 on
        ("avx512f avx512_bf16 sse4a", True),  # Zen 4
        ("avx512f avx512_bf16", False),  # Cooper Lake, or a Xeon whose host keeps AMX back
        ("avx512f sse4a", False),
        ("avx2 amx_bf16 amx_tile", False),
    ],
)
def test_bfloat16_is_taken_where_it_is_faster(flags: str, faster: bool) -> None:
    assert is_faster_on(frozenset(flags.split())) is faster


def test_where_it_is_faster_and_there_is_a_compiler_it_is_in_c() -> None:
    has = is_faster_on(processor_flags()) and shutil.which("cc") is not None
    text = jax.jit(rounded_matmul).lower(jnp.ones((32, 32)), jnp.ones((32, 32))).as_text()
    assert ("edqn_product" in text) is is_available() is has


def test_what_is_not_finite_stays_so() -> None:
    x, kernel = numbers(0, 40, 64), np.abs(numbers(1, 64, 40))
    x[7, 3], x[9, 5] = np.nan, np.inf
    found = np.asarray(rounded_matmul(x, kernel))
    assert (
        np.all(np.isnan(found[7]))
        and np.all(np.isposinf(found[9]))
        and np.all(np.isfinite(np.delete(found, (7, 9), 0)))
    )


@pytest.mark.whole
def test_a_network_is_rounded_where_it_is_asked_for_alone() -> None:
    config = AgentConfig()
    params = init_q(config, 40, 27, jax.random.key(0))
    history = jnp.asarray(numbers(0, 64, config.history, 40))

    def values(name: str) -> np.ndarray:
        with in_precision(name):
            return np.asarray(q_values(config, params, 27, history))

    plain = np.asarray(q_values(config, params, 27, history))
    np.testing.assert_array_equal(values("float32"), plain)
    size = np.abs(plain).max()
    assert 1e-5 * size < np.abs(values("bfloat16") - plain).max() < 1e-2 * size
    np.testing.assert_array_equal(values("auto"), values("bfloat16" if is_available() else "float32"))
    assert not are_rounded()
    # What is not trained has derivatives of any kind.
    forward = jax.jacfwd(lambda history: q_values(config, params, 27, history))(history[0])
    backward = jax.jacrev(lambda history: q_values(config, params, 27, history))(history[0])
    np.testing.assert_allclose(forward, backward, atol=1e-5)
    np.testing.assert_array_equal(matmul(history[:, 0], jnp.eye(40)), history[:, 0])
