"""Returns of PQN against numbers worked out by hand, and rollouts against a plain walk through the rows."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.learn import replay
from edqn_jax.learn.pqn.returns import lambda_returns, rollout_of
from edqn_jax.sim.task.outcomes import Outcome

R, Q = jnp.array([1.0, 2.0, 4.0]), jnp.array([10.0, 20.0, 30.0])
RUNNING = [int(Outcome.RUNNING)] * 3


def returns(outcomes, trace):
    return np.asarray(lambda_returns(R, Q, jnp.array(outcomes), 0.5, trace))


def test_trace_zero_gives_one_step_targets():
    np.testing.assert_allclose(returns(RUNNING, 0.0), [1 + 5, 2 + 10, 4 + 15])


def test_trace_one_gives_the_discounted_sum_and_the_last_bootstrap():
    np.testing.assert_allclose(returns(RUNNING, 1.0), [1 + 0.5 * (2 + 0.5 * 19), 2 + 0.5 * 19, 19])


def test_half_of_each_in_between():
    last = 4 + 15
    middle = 2 + 0.5 * (0.5 * 20 + 0.5 * last)
    np.testing.assert_allclose(returns(RUNNING, 0.5), [1 + 0.5 * (0.5 * 10 + 0.5 * middle), middle, last])


@pytest.mark.parametrize(
    ("outcome", "bootstrap"), [(Outcome.GOAL, 0.0), (Outcome.COLLISION, 0.0), (Outcome.TIME_OUT, 20.0)]
)
def test_only_a_terminal_outcome_cuts_the_bootstrap_and_no_return_crosses_an_end(outcome, bootstrap):
    ended = [int(Outcome.RUNNING), int(outcome), int(Outcome.RUNNING)]
    found = returns(ended, 1.0)
    np.testing.assert_allclose(found[1], 2 + 0.5 * bootstrap)
    np.testing.assert_allclose(found[0], 1 + 0.5 * found[1])


def test_a_rollout_is_what_a_plain_walk_through_the_rows_finds():
    length, steps, history, decisions, size = 9, 23, 2, 5, 3
    draw = np.random.default_rng(4)
    written = []
    ring = jax.tree.map(lambda leaf: leaf[:, 0], replay.empty_ring(length, 1, size))
    ended = False
    for time in range(steps):
        outcome = Outcome.RUNNING if ended else draw.choice([Outcome.RUNNING] * 3 + [Outcome.GOAL, Outcome.DIVERGED])
        row = replay.Rows(
            observation=jnp.asarray(draw.normal(size=size), jnp.float32),
            reward=jnp.float32(draw.normal()),
            outcome=jnp.int8(int(outcome)),
            is_reset=jnp.asarray(ended),
            action=jnp.int8(draw.integers(27)),
        )
        ended = outcome != Outcome.RUNNING
        written.append(row)
        ring = replay.store_decision(ring, row, jnp.int32(time))
    found = rollout_of(ring, jnp.int32(steps - 1), decisions, history)
    for number in range(decisions + 1):
        now = steps - 1 - decisions + number
        before = written[now - 1].observation if not written[now].is_reset else np.zeros(size)
        np.testing.assert_array_equal(found.history[number], [before, written[now].observation])
        if number == decisions:
            continue
        assert found.action[number] == written[now].action
        assert found.reward[number] == written[now + 1].reward
        assert found.outcome[number] == written[now + 1].outcome
        starts = written[now].outcome == Outcome.RUNNING and written[now + 1].outcome != Outcome.DIVERGED
        assert bool(found.weight[number]) == starts
