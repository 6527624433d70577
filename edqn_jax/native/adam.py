"""Adam (Kingma & Ba 2015), and moving averages that follow the parameters."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from edqn_jax.native.build import ensure_registered
from edqn_jax.native.own_programs import is_own_program

SOURCE = Path(__file__).with_suffix(".c")

TARGET = "edqn_adam"

FIRST_DECAY, SECOND_DECAY, EPSILON = 0.9, 0.999, 1e-8

NO_LIMIT = -1.0
"""To C, the longest norm of gradients that are not shortened."""


class Stepped(NamedTuple):
    """What a step leaves."""

    params: Any  # a plain pytree, as the next two
    state: Any  # of the optimiser
    averages: tuple[Any, ...]
    finite: Array  # [] bool, whether the gradient was; else all the rest is as before


@dataclasses.dataclass(frozen=True)
class Adam:
    """Adam, which changes nothing where a gradient is not finite, however often.

    Its state is that of `optax.adam` in `optax.apply_if_finite`. In the package's own programs `adam.c` does a step of
    parameters that are one float32 vector, on CPUs with a C compiler.
    """

    rate: Array | float | optax.Schedule
    """Step size."""

    max_norm: float | None = None
    """Longer gradients are shortened to this norm; None leaves them as they are."""

    def init(self, params: Any) -> Any:
        """Returns the state of an optimiser that has seen nothing."""
        return self._in_optax().init(params)

    def step(
        self,
        gradient: Any,
        state: Any,
        params: Any,
        averages: tuple[tuple[Any, float], ...] = (),
        scale: Array | float = 1.0,
    ) -> Stepped:
        """Takes a step.

        Args:
            averages: moving averages of the parameters, and the share of the new parameters in each.
            scale: [] by which the gradient is multiplied first.
        """
        arrays = jax.tree.leaves((params, gradient, [old for old, _ in averages]))
        are_vectors = isinstance(params, Array) and all(x.ndim == 1 and x.dtype == jnp.float32 for x in arrays)
        if is_own_program() and are_vectors and jax.default_backend() == "cpu" and is_available():
            return self._step_in_c(gradient, state, params, averages, scale)
        gradient = jax.tree.map(lambda x: x * scale, gradient)
        change, state = self._in_optax().update(gradient, state, params)
        params = optax.apply_updates(params, change)

        def follow(old: Any, rate: float) -> Any:
            moved = polyak_update(params, old, rate)
            return jax.tree.map(lambda new, before: jnp.where(state.last_finite, new, before), moved, old)

        return Stepped(params, state, tuple(follow(old, rate) for old, rate in averages), state.last_finite)

    def _step_in_c(
        self,
        gradient: Array,
        state: Any,
        params: Array,
        averages: tuple[tuple[Array, float], ...],
        scale: Array | float,
    ) -> Stepped:
        inner = state.inner_state
        moments = optax.tree_utils.tree_get(inner, "ScaleByAdamState")
        count = optax.safe_increment(moments.count)
        rate = self.rate(moments.count) if callable(self.rate) else self.rate
        first, second = (1.0 / (1.0 - decay**count) for decay in (FIRST_DECAY, SECOND_DECAY))
        rates = [rate for _, rate in averages]
        max_norm = NO_LIMIT if self.max_norm is None else self.max_norm
        numbers = (scale, max_norm, rate * first, FIRST_DECAY, SECOND_DECAY, second, EPSILON, *rates)
        changed = (params, moments.mu, moments.nu, *(old for old, _ in averages))
        shapes = [jax.ShapeDtypeStruct(params.shape, params.dtype)] * len(changed)
        call = jax.ffi.ffi_call(
            TARGET,
            (*shapes, jax.ShapeDtypeStruct((), jnp.bool_)),
            vmap_method="broadcast_all",
            input_output_aliases={2 + number: number for number in range(len(changed))},
        )
        packed = jnp.stack([jnp.asarray(number, jnp.float32) for number in numbers])
        params, mu, nu, *followed, finite = call(packed, gradient, *changed)
        state = optax.ApplyIfFiniteState(
            notfinite_count=jnp.where(finite, 0, optax.safe_increment(state.notfinite_count)),
            last_finite=finite,
            total_notfinite=jnp.where(finite, state.total_notfinite, optax.safe_increment(state.total_notfinite)),
            inner_state=optax.tree_utils.tree_set(inner, mu=mu, nu=nu, count=jnp.where(finite, count, moments.count)),
        )
        return Stepped(params, state, tuple(followed), finite)

    def _in_optax(self) -> optax.GradientTransformation:
        adam = optax.adam(self.rate, FIRST_DECAY, SECOND_DECAY, EPSILON)
        if self.max_norm is not None:
            adam = optax.flatten(optax.chain(optax.clip_by_global_norm(self.max_norm), adam))
        return optax.apply_if_finite(adam, max_consecutive_errors=2**31 - 1)


def polyak_update(new: Any, old: Any, rate: float) -> Any:
    """Returns old + rate (new - old), leaf by leaf: the target network's soft update, tau of Table 1."""
    return optax.incremental_update(new, old, rate)


def is_available() -> bool:
    """Returns whether the library is loaded and registered, which the first call does."""
    return ensure_registered(SOURCE, (TARGET,))
