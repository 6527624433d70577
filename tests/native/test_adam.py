"""Adam in one pass in C, against optax."""

from __future__ import annotations

import math
import shutil
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import Array

from edqn_jax.native.adam import TARGET, Adam, Stepped, polyak_update
from edqn_jax.native.own_programs import own_program

HAS_COMPILER = shutil.which("cc") is not None
RATES = 0.25, 0.01
"""Of the averages that follow."""


def in_optax(rate: Any, max_norm: float | None, gradients: list[Array], params: Any) -> tuple[Any, ...]:
    """Returns parameters, both averages and moments after steps of `optax.adam`, as its users write them."""
    adam = optax.adam(rate)
    if max_norm is not None:
        adam = optax.chain(optax.clip_by_global_norm(max_norm), adam)
    state, averages = adam.init(params), [params, params]
    for gradient in gradients:
        change, state = adam.update(gradient, state, params)
        params = optax.apply_updates(params, change)
        averages = [old + rate * (params - old) for old, rate in zip(averages, RATES, strict=True)]
    return params, *averages, *(optax.tree_utils.tree_get(state, name) for name in ("mu", "nu"))


def steps(adam: Adam, gradients: Array, params: Array, scale: float) -> Stepped:
    """Takes a step for each gradient [K, n]."""

    def one(carried: Any, gradient: Array) -> tuple[Any, Array]:
        params, averages, state = carried
        new = adam.step(gradient, state, params, tuple(zip(averages, RATES, strict=True)), scale)
        return (new.params, new.averages, new.state), new.finite

    begin = params, (params, params), adam.init(params)
    (params, averages, state), finite = jax.lax.scan(one, begin, gradients)
    return Stepped(params, state, averages, finite)


def run(adam: Adam, gradients: Array, params: Array, *, in_c: bool, scale: float = 1.0) -> Stepped:
    program = jax.jit(lambda g, p: steps(adam, g, p, scale))
    if not in_c:
        return program(gradients, params)
    with own_program():
        return program(gradients, params)


@pytest.mark.parametrize("in_c", [True, False])
@pytest.mark.parametrize(("size", "max_norm"), [(7, None), (37, 0.5), (37, math.inf), (1300, 0.5), (1024, 1e6)])
def test_steps_are_those_of_optax(size: int, max_norm: float | None, in_c: bool) -> None:
    rng = np.random.default_rng(size)
    params, gradients = jnp.asarray(rng.normal(size=size), jnp.float32), rng.normal(size=(4, size)).astype(np.float32)
    rate = 1e-2 if max_norm is None else optax.linear_schedule(1e-2, 1e-3, 3)
    found = run(Adam(rate, max_norm), jnp.asarray(gradients), params, in_c=in_c, scale=0.5)
    wanted = in_optax(rate, max_norm, [jnp.asarray(each) / 2 for each in gradients], params)
    moments = [optax.tree_utils.tree_get(found.state, name) for name in ("mu", "nu")]
    assert found.finite.all()
    for ours, theirs in zip((found.params, *found.averages, *moments), wanted, strict=True):
        # Both round each number a few times, in another order.
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-7)
    assert int(found.state.inner_state[-1][0].count if max_norm else found.state.inner_state[0].count) == 4


@pytest.mark.parametrize("in_c", [True, False])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [3, 69])
def test_a_gradient_that_is_not_finite_changes_nothing(wrong: float, place: int, in_c: bool) -> None:
    rng = np.random.default_rng(0)
    params, gradients = jnp.asarray(rng.normal(size=70), jnp.float32), rng.normal(size=(3, 70)).astype(np.float32)
    with_one = gradients.copy()
    with_one[1, place] = wrong
    adam = Adam(1e-2, 0.5)
    found = run(adam, jnp.asarray(with_one), params, in_c=in_c)
    wanted = run(adam, jnp.asarray(gradients[[0, 2]]), params, in_c=in_c)
    np.testing.assert_array_equal(found.finite, [True, False, True])
    assert int(found.state.total_notfinite) == 1 and int(found.state.notfinite_count) == 0
    assert bool(found.state.last_finite)
    jax.tree.map(
        lambda ours, theirs: np.testing.assert_array_equal(ours, theirs),
        (found.params, found.averages, found.state.inner_state),
        (wanted.params, wanted.averages, wanted.state.inner_state),
    )


def test_what_a_step_begins_with_is_not_lost() -> None:
    params, gradient, adam = jnp.arange(5.0), jnp.ones(5), Adam(0.1)

    def both(params: Array) -> tuple[Array, Array]:
        return adam.step(gradient, adam.init(params), params).params, params

    with own_program():
        after, before = jax.jit(both)(params)
    np.testing.assert_array_equal(before, np.arange(5.0))
    np.testing.assert_allclose(after, before - 0.1, rtol=1e-5)
    np.testing.assert_array_equal(params, np.arange(5.0))


def test_one_array_may_be_all_that_a_step_is_given() -> None:
    params, adam = jnp.asarray(np.random.default_rng(1).normal(size=40), jnp.float32), Adam(0.1, 1.0)

    def step(x: Array) -> Stepped:
        return adam.step(x, adam.init(x), x, ((x, 0.5), (x, 0.5)))

    with own_program():
        found = jax.jit(step)(params)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=2e-6), found, step(params))


def test_the_state_is_that_of_optax() -> None:
    """Runs of earlier versions go on from it."""
    vector = jnp.ones(5)
    plain, clipped = (
        optax.adam(0.1),
        optax.chain(optax.clip_by_global_norm(1.0), optax.adam(optax.constant_schedule(1))),
    )
    for ours, theirs in ((Adam(0.1), plain), (Adam(lambda _: 0.1, 1.0), optax.flatten(clipped))):
        wanted = optax.apply_if_finite(theirs, 10).init(vector)
        with own_program():
            after = jax.jit(lambda x, adam=ours: adam.step(x, adam.init(x), x).state)(vector)
        for state in (ours.init(vector), after):
            assert jax.tree.structure(state) == jax.tree.structure(wanted)
            assert jax.tree.map(jnp.shape, state) == jax.tree.map(jnp.shape, wanted)


def test_of_many_vectors_each_takes_its_step() -> None:
    rng = np.random.default_rng(1)
    params, gradients = (jnp.asarray(rng.normal(size=(3, 600)), jnp.float32) for _ in range(2))
    gradients, adam = gradients.at[1, 5].set(jnp.nan), Adam(0.1, 1.0)

    def step(gradient: Array, params: Array) -> Stepped:
        return adam.step(gradient, adam.init(params), params, ((jnp.zeros(600), 0.25), (params, 0.5)))

    with own_program():
        found = jax.jit(jax.vmap(step))(gradients, params)
    np.testing.assert_array_equal(found.finite, [True, False, True])
    for number in range(3):
        wanted = step(gradients[number], params[number])
        jax.tree.map(
            lambda ours, theirs: np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=2e-6),
            jax.tree.map(lambda x: x[number], found),  # noqa: B023
            wanted,
        )


def test_only_vectors_in_programs_of_ours_are_stepped_in_c() -> None:
    adam = Adam(0.1)

    def text(params: Any) -> str:
        return jax.jit(lambda p: adam.step(p, adam.init(p), p)).lower(params).as_text()

    assert TARGET not in text(jnp.ones(4))
    with own_program():
        assert (TARGET in text(jnp.ones(5))) is HAS_COMPILER
        assert TARGET not in text({"a": jnp.ones(4)}) and TARGET not in text(jnp.ones((2, 3)))
        assert TARGET not in text(jnp.ones(5, jnp.bfloat16))
        assert ("output_operand_alias" in text(jnp.ones(6))) is HAS_COMPILER  # in place


def test_polyak_moves_by_its_rate() -> None:
    new, old = {"a": jnp.array([4.0, 0.0])}, {"a": jnp.array([0.0, 8.0])}
    np.testing.assert_allclose(polyak_update(new, old, 0.25)["a"], [1.0, 6.0])
