"""Compares the replay with a plain list of all transitions."""

from __future__ import annotations

import dataclasses
from collections import Counter
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edqn_jax.config import AgentConfig, Config
from edqn_jax.learn import replay
from edqn_jax.sim.task.observation import OWN_SIZE, rotate_own_state
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.task import task_of
from tests.oracles import replay_plain

ENVS, LENGTH, BATCH, LONGEST = 3, 17, 96, 80
ENDS = [Outcome.GOAL, Outcome.COLLISION, Outcome.LEFT_VOLUME, Outcome.TIME_OUT, Outcome.DIVERGED]


def agent(n_step: int, history: int) -> AgentConfig:
    return AgentConfig(n_step=n_step, history=history, discount=0.9, replay_size=LENGTH * ENVS)


FORMS = {"plain": agent(1, 1), "stacked": agent(3, 2), "long": agent(5, 4)}


def lives(rng: np.random.Generator, decisions: int, end_chance: float) -> list[list[replay_plain.Row]]:
    """Returns the rows of E environments; every observation holds its own time and environment."""
    found = []
    for env in range(ENVS):
        rows: list[replay_plain.Row] = []
        for time in range(decisions):
            ended = bool(rows) and rows[-1].outcome != Outcome.RUNNING
            ends = not ended and time > 0 and rng.uniform() < end_chance
            rows.append(
                replay_plain.Row(
                    observation=np.array([time + 1.0, env + 1.0]),
                    reward=0.0 if ended or time == 0 else float(rng.integers(-9, 10)),
                    outcome=int(rng.choice(ENDS)) if ends else int(Outcome.RUNNING),
                    is_reset=ended or time == 0,
                    action=int(rng.integers(27)),
                )
            )
        found.append(rows)
    return found


@partial(jax.jit, static_argnums=0)
def written(config: AgentConfig, rows: replay.Rows, decisions) -> replay.Rows:
    """A ring after the first `decisions` of `rows` [LONGEST, E, ...]."""

    def store(ring, time):
        row = jax.tree.map(lambda x: x[time], rows)
        kept = replay.store_decision(ring, row, time)
        return jax.tree.map(lambda a, b: jnp.where(time < decisions, a, b), kept, ring), None

    return jax.lax.scan(store, replay.empty_ring(replay.ring_length(config, ENVS), ENVS, 2), jnp.arange(LONGEST))[0]


def ring_of(config: AgentConfig, life: list[list[replay_plain.Row]]) -> replay.Rows:
    decisions = len(life[0])

    def column(name: str, dtype) -> np.ndarray:
        values = np.array([[getattr(row, name) for row in rows] for rows in life], dtype)
        values = np.swapaxes(values, 0, 1)
        return np.concatenate([values, np.zeros((LONGEST - decisions, *values.shape[1:]), dtype)])

    rows = replay.Rows(
        observation=column("observation", np.float32),  # type: ignore[arg-type]
        reward=column("reward", np.float32),  # type: ignore[arg-type]
        outcome=column("outcome", np.int8),  # type: ignore[arg-type]
        is_reset=column("is_reset", bool),  # type: ignore[arg-type]
        action=column("action", np.int8),  # type: ignore[arg-type]
    )
    return written(config, rows, decisions)


sampled = jax.jit(replay.sample_transitions, static_argnums=(0, 3))


def starts(batch: replay.Batch) -> list[tuple[int, int]]:
    """(time, environment) at which each sample begins, from what its newest observation says."""
    newest = np.asarray(batch.history)[:, -1]
    return [(int(time) - 1, int(env) - 1) for time, env in newest]


@pytest.mark.parametrize("form", FORMS)
@settings(max_examples=20, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    decisions=st.integers(10, LONGEST),  # up to nearly five times round the ring
    end_chance=st.sampled_from([0.02, 0.15, 0.5]),
)
@pytest.mark.slow
def test_samples_are_what_really_happened(form, seed, decisions, end_chance):
    config = FORMS[form]
    life = lives(np.random.default_rng(seed), decisions, end_chance)
    ring = ring_of(config, life)
    batch = sampled(config, ring, decisions - 1, BATCH, jax.random.key(seed % 2**31))
    for i, (time, env) in enumerate(starts(batch)):
        true = replay_plain.transition(life[env], time, config.n_step, config.discount, config.history)
        assert float(batch.weight[i]) == true.weight
        np.testing.assert_array_equal(batch.history[i], true.history)
        assert int(batch.action[i]) == true.action
        if true.weight:  # an episode's last row starts nothing; what else stands there does not matter
            np.testing.assert_allclose(batch.returns[i], true.returns, rtol=1e-5, atol=1e-5)
            np.testing.assert_allclose(batch.discount[i], true.discount, rtol=1e-6)
            np.testing.assert_array_equal(batch.next_history[i], true.next_history)


@pytest.mark.parametrize("decisions", [10, LENGTH, LENGTH + 4, 3 * LENGTH + 1])
@pytest.mark.parametrize("form", FORMS)
def test_every_row_that_can_start_a_transition_is_drawn_and_no_other(form, decisions):
    config = FORMS[form]
    ring = ring_of(config, lives(np.random.default_rng(0), decisions, 0.2))
    drawn = Counter(starts(sampled(config, ring, decisions - 1, 6000, jax.random.key(1))))
    oldest = max(decisions - LENGTH, 0)
    times = range(oldest + config.history - 1, decisions - config.n_step)
    assert set(drawn) == {(time, env) for time in times for env in range(ENVS)}
    # Uniform: chi-square over the cells, mean k - 1 and variance 2 (k - 1); six deviations are a bug.
    expected = 6000 / len(drawn)
    chi2 = sum((count - expected) ** 2 / expected for count in drawn.values())
    freedom = len(drawn) - 1
    assert abs(chi2 - freedom) < 6 * np.sqrt(2 * freedom)


def by_hand(outcome: Outcome) -> replay.Batch:
    """Rewards 1, 2, 4, 8 and an end at the second; n = 4 reaches the third: the sample before the first."""
    config = agent(4, 2)
    rows = []
    for time, reward in enumerate([0.0, 0.0, 1.0, 2.0, 0.0, 4.0, 8.0]):
        rows.append(
            replay_plain.Row(
                observation=np.array([time + 1.0, 1.0]),
                reward=reward,
                outcome=int(outcome) if time == 3 else 0,
                is_reset=time in (0, 4),
                action=time,
            )
        )
    ring = ring_of(config, [rows] * ENVS)
    batch = sampled(config, ring, len(rows) - 1, BATCH, jax.random.key(2))
    begin = [int(h[-1, 0]) - 1 for h in batch.history].index(1)
    return jax.tree.map(lambda x: np.asarray(x[begin]), batch)


def test_a_terminal_end_cuts_the_bootstrap_and_the_rewards_behind_it():
    one = by_hand(Outcome.COLLISION)
    assert one.returns == pytest.approx(1 + 0.9 * 2) and one.discount == 0.0 and one.action == 1
    np.testing.assert_array_equal(one.history[:, 0], [1, 2])


def test_what_led_to_a_divergence_is_not_learnt_from():
    assert by_hand(Outcome.DIVERGED).weight == 0.0 and by_hand(Outcome.COLLISION).weight == 1.0


def test_a_time_out_bootstraps_from_the_final_observation():
    one = by_hand(Outcome.TIME_OUT)
    assert one.returns == pytest.approx(1 + 0.9 * 2) and one.discount == pytest.approx(0.9**2)
    np.testing.assert_array_equal(one.next_history[:, 0], [3, 4])  # row 3, not the reset behind it


def test_without_an_end_the_bootstrap_is_n_steps_away():
    one = by_hand(Outcome.RUNNING)  # the reset behind row 3 then only blanks the history
    assert one.returns == pytest.approx(1 + 0.9 * 2 + 0.81 * 0 + 0.729 * 4) and one.discount == pytest.approx(0.9**4)


def test_history_is_blank_before_a_reset():
    rows = np.arange(1.0, 9.0).reshape(4, 2)
    stacked = partial(replay.stack_observations, jnp.asarray(rows))
    np.testing.assert_array_equal(stacked(jnp.zeros(4, bool)), rows)
    np.testing.assert_array_equal(stacked(jnp.array([True, False, False, False])), rows)
    expected = rows * np.array([[0], [0], [1], [1]])
    np.testing.assert_array_equal(stacked(jnp.array([False, False, True, False])), expected)
    np.testing.assert_array_equal(stacked(jnp.array([True, False, True, False])), expected)
    np.testing.assert_array_equal(stacked(jnp.array([False, False, True, True]))[:3], np.zeros((3, 2)))


def test_the_ring_is_as_long_as_its_share_and_never_too_short_for_a_transition():
    config = AgentConfig(replay_size=1000, n_step=5, history=3)
    assert replay.ring_length(config, 10) == 100
    assert replay.ring_length(config, 500) == 9
    ring = replay.empty_ring(replay.ring_length(config, 10), 4, 7)
    assert ring.observation.shape == (100, 4, 7) and ring.reward.shape == (100, 4)


@pytest.mark.usefixtures("strict_jax")
@pytest.mark.slow
def test_the_replay_is_strict():
    config = agent(3, 2)
    ring = replay.empty_ring(replay.ring_length(config, ENVS), ENVS, 5)
    rows = jax.tree.map(lambda x: x[0], ring)
    ring = jax.jit(replay.store_decision)(ring, rows, jnp.int32(20))
    batch = sampled(config, ring, jnp.int32(20), 8, jax.random.key(0))
    assert batch.history.shape == (8, 2, 5) and batch.action.dtype == jnp.int32


def test_what_is_drawn_is_turned_in_whole_quarters_and_only_the_own_state_is() -> None:
    rng, config, write = (
        np.random.default_rng(5),
        dataclasses.replace(agent(3, 2), turn=True),
        jax.jit(replay.store_decision),
    )
    ring = replay.empty_ring(replay.ring_length(config, ENVS), ENVS, 3 + OWN_SIZE)
    for time in range(LENGTH):
        rows = replay.Rows(
            observation=jnp.asarray(rng.normal(size=(ENVS, 3 + OWN_SIZE)), jnp.float32),
            reward=jnp.zeros(ENVS),
            outcome=jnp.full(ENVS, int(Outcome.RUNNING)),
            is_reset=jnp.full(ENVS, time % 5 == 0),
            action=jnp.zeros(ENVS, jnp.int32),
        )
        ring = write(ring, rows, jnp.int32(time))
    drawn = jax.jit(replay.sample_transitions, static_argnums=(0, 3, 5))(
        config, ring, jnp.int32(LENGTH - 1), 256, jax.random.key(0), task_of(Config())
    )
    rows = np.asarray(ring.observation).reshape(-1, 3 + OWN_SIZE)
    turned_rows = {row[:3].tobytes(): [] for row in rows}
    for quarters in range(4):
        for row, own in zip(
            rows, np.asarray(rotate_own_state(jnp.asarray(rows[:, 3:]), jnp.full(len(rows), quarters))), strict=True
        ):
            turned_rows[row[:3].tobytes()].append(own)
    turns = Counter()
    for transition in np.concatenate([drawn.history, drawn.next_history], axis=1):
        seen = [each for each in transition if each.any()]  # the others are from before the episode
        found = {
            quarters
            for each in seen
            for quarters, own in enumerate(turned_rows[each[:3].tobytes()])
            if np.allclose(own, each[3:], atol=1e-6)
        }
        assert len(found) == 1, "one transition is turned as a whole"
        turns.update(found)
    # A quarter of 256 each: 64, five deviations of 7.
    assert set(turns) == set(range(4)) and min(turns.values()) > 29
