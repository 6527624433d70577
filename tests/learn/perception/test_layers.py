"""The linear layer whose gradient is written by hand, against Flax's."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.learn.perception import layers
from tests.support.marks import in_whole


@pytest.mark.parametrize("rows", [(), (3,), (4, 5), (2 * layers.ROWS_OF_A_PART + 6,)])
@pytest.mark.parametrize("use_bias", [True, *in_whole(False)])
def test_a_layer_is_that_of_flax_with_its_gradients(rows: tuple[int, ...], use_bias: bool) -> None:
    keys = jax.random.split(jax.random.key(0), 3)
    x, weight = jax.random.normal(keys[0], (*rows, 7)), jax.random.normal(keys[1], (*rows, 3))
    ours, theirs = layers.Dense(3, use_bias=use_bias), nn.Dense(3, use_bias=use_bias)
    params = theirs.init(keys[2], x)
    assert jax.tree.all(jax.tree.map(np.array_equal, ours.init(keys[2], x), params))

    def gradients(layer: nn.Module):
        return jax.grad(lambda p, x: jnp.sum(weight * jnp.square(jnp.asarray(layer.apply(p, x)))), argnums=(0, 1))(
            params, x
        )

    for found, wanted in zip(jax.tree.leaves(gradients(ours)), jax.tree.leaves(gradients(theirs)), strict=True):
        # Sums of up to 32 774 terms in float32, in another order.
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4 * max(1.0, float(np.max(np.abs(wanted)))))


def test_what_is_added_to_all_rows_collects_the_gradients_of_all() -> None:
    x, shared = jnp.arange(24.0).reshape(2, 2, 2, 3), jnp.ones((2, 3))
    np.testing.assert_array_equal(layers.add_shared(x, shared), x + 1.0)
    weight = jnp.arange(24.0).reshape(x.shape)
    of_x, of_shared = jax.grad(lambda x, s: jnp.sum(weight * layers.add_shared(x, s)), argnums=(0, 1))(x, shared)
    np.testing.assert_array_equal(of_x, weight)
    np.testing.assert_array_equal(of_shared, weight.sum(axis=(0, 1)))


def test_weights_are_the_parameters_of_a_layer() -> None:
    x, key = jnp.ones((2, 7)), jax.random.key(0)
    wanted = layers.Dense(3).init(key, x)
    assert jax.tree.all(jax.tree.map(np.array_equal, layers.Weights(3).init(key, 7), wanted))
    alone = layers.Weights(3, use_bias=False).apply({"params": {"kernel": jnp.ones((7, 3))}}, 7)
    jax.tree.map(np.testing.assert_array_equal, alone, [np.ones((7, 3))])


def test_what_is_added_to_each_row_of_an_image_collects_the_gradients_of_its_rows() -> None:
    rows, one = jnp.arange(24.0).reshape(2, 4, 3), jnp.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    np.testing.assert_array_equal(layers.add_to_each(rows, one), rows + one[:, None])
    weight = jnp.arange(24.0).reshape(rows.shape)
    of_rows, of_one = jax.grad(lambda r, o: jnp.sum(weight * layers.add_to_each(r, o)), argnums=(0, 1))(rows, one)
    np.testing.assert_array_equal(of_rows, weight)
    np.testing.assert_array_equal(of_one, weight.sum(axis=1))
