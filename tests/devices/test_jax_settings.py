"""Within the package JAX has the settings that were tested, whatever a process has set."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import edqn_jax
from edqn_jax.devices.jax_settings import TESTED, as_tested, keep_tested_settings, set_as_tested, untested_settings
from edqn_jax.interop import functional
from tests.support.miniature import WORLD

OTHER: dict[str, Any] = {
    "jax_enable_x64": True,
    "jax_numpy_dtype_promotion": "strict",
    "jax_numpy_rank_promotion": "raise",
    "jax_transfer_guard": "disallow",
    "jax_transfer_guard_host_to_device": "disallow_explicit",
    "jax_disable_jit": True,
    "jax_debug_nans": True,
    "jax_debug_infs": True,
    "jax_check_tracer_leaks": True,
    "jax_debug_key_reuse": True,
    "jax_default_prng_impl": "rbg",
    "jax_threefry_partitionable": False,
    "jax_default_matmul_precision": "highest",
}
"""Values that a process may have set, none of which is the tested one."""


@contextlib.contextmanager
def set_for_process(**values: Any) -> Iterator[None]:
    """Settings of the whole process within the block, as a notebook's first cell has them."""
    guards = [name for name in jax.config.values if name.startswith("jax_transfer_guard_")]
    before = {name: jax.config.values[name] for name in ("jax_transfer_guard", *guards, *TESTED, *values)}
    try:
        for name, value in values.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, getattr(value, "value", value))


@pytest.mark.parametrize(("name", "value"), OTHER.items())
def test_a_function_of_the_package_runs_with_the_tested_value(name: str, value: Any) -> None:
    assert untested_settings() == []
    with set_for_process(**{name: value}):
        assert untested_settings()
        assert as_tested(untested_settings)() == []
        assert untested_settings()  # and the user's own again


@pytest.mark.parametrize(("name", "value"), OTHER.items())
def test_a_command_sets_the_tested_value_and_tells_the_variable(name: str, value: Any) -> None:
    with set_for_process(**{name: value}):
        (told,) = set_as_tested()
        assert told.startswith(f"{name.upper()}=")
        assert untested_settings() == [] and set_as_tested() == []


def test_a_thread_of_a_pool_keeps_the_tested_settings() -> None:
    with (
        set_for_process(jax_enable_x64=True),
        ThreadPoolExecutor(1, initializer=keep_tested_settings) as kept,
        ThreadPoolExecutor(1) as other,
    ):
        assert kept.submit(untested_settings).result() == [] and kept.submit(untested_settings).result() == []
        assert other.submit(untested_settings).result() == ["jax_enable_x64"]


def wide(tree: Any) -> set[str]:
    """Types of 64 bits in a tree."""
    return {str(x.dtype) for x in jax.tree.leaves(tree) if "64" in str(getattr(x, "dtype", ""))}


@pytest.mark.whole
@pytest.mark.slow
def test_what_is_flown_is_the_same_in_double_precision_and_strictness() -> None:
    environment = edqn_jax.make(WORLD)
    state, observation = environment.reset(0)
    flown, step = environment.step(state, "ahead")
    with set_for_process(
        jax_enable_x64=True,
        jax_numpy_dtype_promotion="strict",
        jax_numpy_rank_promotion="raise",
        jax_transfer_guard="disallow",
        jax_default_prng_impl="rbg",
    ):
        again = edqn_jax.make(WORLD)
        fresh, seen = again.reset(0)
        after, other = again.step(fresh, "ahead")
        assert not wide((fresh, seen, after, other))
        # Within a program of the user's own, and with a move of its precision.
        moved = jax.jit(lambda state, q: again.step(state, jnp.argmax(q)))
        with jax.transfer_guard("allow"):
            inner = moved(fresh, jnp.eye(27)[edqn_jax.move_number("ahead")])
        assert not wide(inner)
    for one in ((after, other), inner):
        same = jax.tree.map(lambda x, y: x.dtype == y.dtype, (flown, step), one)
        assert all(jax.tree.leaves(same))
        np.testing.assert_allclose(step.flight.position, one[1].flight.position, rtol=1e-5)


@pytest.mark.whole
@pytest.mark.slow
def test_functions_of_the_task_keep_their_types_in_a_program_of_double_precision() -> None:
    env, params = functional.make(WORLD, observation="kinematics")
    with set_for_process(jax_enable_x64=True, jax_numpy_dtype_promotion="strict"):
        _, state = env.reset(jax.random.key(0), params, jnp.asarray(0))
        step = jax.jit(env.step_autoreset)
        stepped = step(jax.random.key(1), state, jnp.asarray(3), params)  # int64
        assert not wide((state, stepped))
