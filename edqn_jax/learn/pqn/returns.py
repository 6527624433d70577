"""Returns of PQN: Peng's Q(lambda) over a rollout that episodes end and resets interrupt.

Named as the literature does, for one environment: T decisions, `q_t` the value of the best action.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from edqn_jax.learn.replay import Rows, stack_observations
from edqn_jax.sim.task.outcomes import Outcome, is_terminal


@struct.dataclass
class Rollout:
    """T decisions of one environment, in time order, and where they led."""

    history: Array  # [T + 1, H, D] observations up to each decision, newest last; zeros before the episode began
    action: Array  # [T] int32, taken at each
    reward: Array  # [T] for it
    outcome: Array  # [T] int32 `Outcome` that it led to
    weight: Array  # [T] 1 for a decision, 0 where an episode had ended (a reset follows) or it led to a divergence


def rollout_of(ring: Rows, time: Array, decisions: int, history: int) -> Rollout:
    """Returns the newest decisions of one environment from a ring [L, ...] of at least `decisions` + `history` rows.

    Args:
        time: [] int32, of the newest row, as in `replay.store_decision`.
        decisions: T.
        history: H.
    """
    length = ring.reward.shape[0]
    at = (time - decisions - history + 1 + jnp.arange(decisions + history)) % length
    rows = jax.tree.map(lambda leaf: leaf[at], ring)
    windows = jnp.arange(decisions + 1)[:, None] + jnp.arange(history)
    arrived, began = rows.outcome[history:].astype(jnp.int32), rows.outcome[history - 1 : -1]
    return Rollout(
        history=jax.vmap(stack_observations)(rows.observation[windows], rows.is_reset[windows]),
        action=rows.action[history - 1 : -1].astype(jnp.int32),
        reward=rows.reward[history:],
        outcome=arrived,
        weight=((began == Outcome.RUNNING) & (arrived != Outcome.DIVERGED)).astype(jnp.float32),
    )


def lambda_returns(r_t: Array, q_t: Array, outcome_t: Array, discount: float, trace: float) -> Array:
    """Returns Peng's Q(lambda) of T decisions (Gallici et al. 2024, Eq. 5): [T].

        G = r                                                   if the decision ended the episode
        G = r + discount q_t                                    if it was cut off by time, or is the last of the rollout
        G = r + discount ((1 - trace) q_t + trace G of the next)  otherwise

    Args:
        r_t: [T] reward of each decision.
        q_t: [T] value of the best action where it led.
        outcome_t: [T] int32 `Outcome` that it led to.
        discount: gamma.
        trace: lambda; 0 gives one-step targets.

    >>> running = jnp.full(2, int(Outcome.RUNNING))
    >>> print(lambda_returns(jnp.array([1.0, 2.0]), jnp.array([4.0, 8.0]), running, 0.5, 0.5))
    [3.5 6. ]
    """
    chex.assert_rank([r_t, q_t, outcome_t], 1)
    chex.assert_equal_shape([r_t, q_t, outcome_t])
    goes_on = (outcome_t == Outcome.RUNNING) & (jnp.arange(r_t.shape[0]) < r_t.shape[0] - 1)
    bootstrap = jnp.where(is_terminal(outcome_t), 0.0, q_t)

    def backward(after: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        r, q, on = row
        value = r + discount * jnp.where(on, (1.0 - trace) * q + trace * after, q)
        return value, value

    return lax.scan(backward, jnp.zeros(()), (r_t, bootstrap, goes_on), reverse=True)[1]
