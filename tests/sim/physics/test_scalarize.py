"""Functions evaluated number by number, against themselves as JAX evaluates them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from edqn_jax.config import Config
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.physics.drone import hover_state
from edqn_jax.sim.physics.flight import fly_decision, physics_step
from edqn_jax.sim.physics.scalarize import scalarize


@jax.custom_vjp
def straight_through(a):
    return jnp.round(a)


straight_through.defvjp(lambda a: (jnp.round(a), None), lambda _, g: (g,))

TABLE = np.array([[1.0, 0.0, 2.0], [0.0, 1.0, -1.0], [0.0, 0.0, 3.0]], np.float32)


def turned(a, b):
    return jnp.einsum("ij,kj->ik", jnp.outer(a, b)[:, ::-1].T, TABLE) @ a - b


def picked(a, b):
    both = jnp.concatenate([a, b])[jnp.array([4, 0, 0, 2])]
    return jnp.stack([both, both[::-1]]).reshape(4, 2)[1:4:2], jnp.tile(a, (2, 1)).T[jnp.array([0, 2]), 1]


def written(a, b):
    table = jnp.asarray(TABLE).at[1].set(a).at[jnp.array([0, 2, 0]), jnp.array([1, 1, 1])].add(b)
    return table.at[jnp.array([1, 7])].set(jnp.stack([b, a]), mode="drop")


def chosen(a, b):
    return (
        jnp.where(a > b, a, 2.0),
        jnp.clip(a, -0.5, 0.5),
        jnp.where(TABLE[0] > 0, a, b),
        (a < 0).all(),
        (b < 0).any(),
    )


def reduced(a, b):
    products = jax.vmap(lambda x: x * b)(a)
    return products.sum(0), products.max(), products.min(1), jnp.linalg.norm(a), jnp.prod(b), jnp.mean(products)


def smooth(a, b):
    return jnp.sin(a) / (1 + b**2), jnp.sqrt(jnp.abs(a)), jnp.cross(a, b), jnp.arctan2(a, b), jax.nn.relu(a), -a / 1.0


def of_constants(a, b):
    del b
    return (
        jnp.sort(jnp.asarray(TABLE), 0) * a,
        jnp.cumsum(TABLE[0]),
        jnp.arange(3) // 2,
        (0.0 - a) + 0.0 * a,
        -1 * a,
        1 - a,
        1 / (a + 9),
    )


def of_whole_numbers(a, b):
    del b
    counted = lax.broadcasted_iota(jnp.int32, (3, 2), 0)
    truths = jnp.asarray(TABLE) > 0
    return (
        jnp.cumsum(counted, 0)[jnp.cumsum(truths[0])] * 1.5,
        lax.cumsum(counted, 1, reverse=True),
        truths.sum(0) + counted.sum(),
        counted.astype(jnp.uint8).sum((0, 1), dtype=jnp.uint8) * jnp.uint8(200),
        truths.astype(jnp.float32) @ a,
        jnp.sign(jnp.abs(counted - 1)) - jnp.isfinite(TABLE[0]).sum(),
    )


@pytest.mark.parametrize("function", [turned, picked, written, chosen, reduced, smooth, of_constants, of_whole_numbers])
def test_the_results_are_those_of_the_function(function: Callable) -> None:
    rng = np.random.default_rng(0)
    for batch in ((), (5,)):
        a, b = (jnp.asarray(rng.normal(size=(*batch, 3)), jnp.float32) for _ in range(2))
        mapped = jax.vmap if batch else lambda same: same
        expected = jax.jit(mapped(function))(a, b)
        got = jax.jit(mapped(scalarize(function)))(a, b)
        assert jax.tree.structure(got) == jax.tree.structure(expected)
        for one, other in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
            assert (one.shape, one.dtype) == (other.shape, other.dtype)
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)


def test_nothing_is_multiplied_with_zeros_and_ones() -> None:
    def rotated(a, b):
        return (jnp.eye(3) @ jnp.stack([a, b, a]) @ jnp.diag(jnp.array([1.0, 0.0, 1.0])))[0] + 0.0 * b

    jaxpr = jax.make_jaxpr(scalarize(rotated))(jnp.ones(3), jnp.ones(3))
    names = {equation.primitive.name for equation in jaxpr.eqns}
    assert not names & {"dot_general", "mul", "add", "gather", "transpose"}


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda a: jax.lax.fori_loop(0, 3, lambda _, x: 2 * x, a), "'scan' cannot be evaluated"),
        (lambda a: jax.lax.cond(a[0] > 0, jnp.sin, jnp.cos, a), "'cond' cannot be evaluated"),
        (jnp.cumsum, "'cumsum' cannot be evaluated"),
        (lambda a: a[jnp.argmax(a)], "'argmax' cannot be evaluated"),
        (lambda a: a[jnp.stack([a[0], a[1]]).astype(int)], "must be a constant when tracing"),
        (lambda a: a.at[5].get(mode="fill", fill_value=0), "must be in bounds"),
        (lambda a: a.at[jnp.array([0, -4])].get(mode="fill", fill_value=0), "must be in bounds"),
        (lambda a: a.at[5].set(1.0, mode="clip"), "must be in bounds where it is clipped"),
        (lambda a: a.at[1].apply(jnp.sin), "cannot be applied at indices"),
        (lambda a: jax.vmap(lambda row, i: row[i])(jnp.stack([a, a]), jnp.array([0, 2])), "must not be mapped by vmap"),
        (lambda a: jax.lax.dot(a.astype("int8"), a.astype("int8"), preferred_element_type="int32"), "in another dtype"),
        (straight_through, "'custom_vjp_call' cannot be evaluated"),
    ],
)
def test_what_cannot_be_evaluated_so_is_refused(function: Callable, message: str) -> None:
    with pytest.raises(NotImplementedError, match=message):
        jax.jit(scalarize(function))(jnp.ones(3))


def test_a_number_times_a_constant_zero_is_zero_whatever_it_is() -> None:
    zeroed = jax.jit(scalarize(lambda a: a @ jnp.asarray(TABLE)))(jnp.array([1.0, np.nan, np.inf]))
    np.testing.assert_array_equal(zeroed[0], 1.0)
    assert not np.isfinite(zeroed[1:]).any()


def test_no_nan_and_no_infinity_passes_a_physics_step_unseen() -> None:
    config = Config().drone
    airframe = load_airframe(config)
    state = hover_state(jnp.zeros(3), jnp.float32(0.3))
    leaves, tree = jax.tree.flatten(dataclasses.replace(state, yaw_setpoint=jnp.float32(0)))
    step = jax.jit(lambda state, thrust: physics_step(config, airframe, state, thrust))

    def moved(state, thrust):
        after = step(state, thrust)
        return np.concatenate([after.position, after.quaternion, after.velocity, after.angular_velocity])

    thrust = jnp.full(4, 3.0)
    assert np.isfinite(moved(state, thrust)).all()
    for wrong in (np.nan, np.inf):
        for which, index in ((leaf, i) for leaf in range(4) for i in range(leaves[leaf].size)):
            broken = [leaf.at[index].set(wrong) if at == which else leaf for at, leaf in enumerate(leaves)]
            assert not np.isfinite(moved(jax.tree.unflatten(tree, broken), thrust)).all(), (which, index)
        assert not np.isfinite(moved(state, thrust.at[2].set(wrong))).all()


def test_a_physics_step_computes_nothing_twice() -> None:
    config = Config().drone
    drones = jax.vmap(hover_state)(jnp.zeros((8, 3)), jnp.zeros(8))
    flown = jax.vmap(lambda drone: fly_decision(config, load_airframe(config), drone, jnp.ones(3), jnp.float32(0)))
    cost: Any = jax.jit(flown).lower(drones).compile().cost_analysis()
    # XLA counts one of the steps: 1,500 operations a drone. Were accelerations fused into what reads them, 5,200.
    assert 500 < cost["flops"] / 8 < 3000
