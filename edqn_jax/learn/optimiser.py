"""Optimisers of Q-networks, and moving averages of parameters."""

from __future__ import annotations

import optax

from edqn_jax.config import AgentConfig
from edqn_jax.learn.qnetwork import Params


def optimiser(config: AgentConfig, updates: int) -> optax.GradientTransformation:
    """Returns Adam with a clipped global norm and a step size that falls linearly over `updates`."""
    rate = optax.linear_schedule(config.learning_rate, config.final_learning_rate, max(updates, 1))
    return optax.flatten(optax.chain(optax.clip_by_global_norm(config.max_gradient_norm), optax.adam(rate)))


def skip_nonfinite(optimiser: optax.GradientTransformation) -> optax.GradientTransformation:
    """Returns an optimiser that changes nothing where a gradient is not finite, however often."""
    return optax.apply_if_finite(optimiser, max_consecutive_errors=2**31 - 1)


def polyak(new: Params, old: Params, rate: float) -> Params:
    """Returns old + rate (new - old), leaf by leaf: the target network's soft update, tau of Table 1."""
    return optax.incremental_update(new, old, rate)
