"""When what is trained: warm-up, retrainings and the learner's own time, without a training step."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config.loading import make_config
from edqn_jax.learn.learner import learner_of
from edqn_jax.learn.schedule import Schedule
from tests.support.configs import TINY, retrained


@pytest.mark.parametrize(("warmup_decisions", "steps"), [(0, 0), (33, 3), (64, 4), (65, 4), (10**6, 4)])
def test_the_warm_up_is_whole_steps_and_a_quarter_of_the_run_at_most(warmup_decisions: int, steps: int) -> None:
    config = dataclasses.replace(TINY, encoder=dataclasses.replace(TINY.encoder, warmup_decisions=warmup_decisions))
    plan = Schedule.from_config(config)
    assert (plan.total, plan.warmup, plan.learn_from) == (16, steps, steps + 5)  # n_step + history rows to learn from


def test_a_retrained_encoder_begins_a_replay_of_its_own() -> None:
    config = retrained((0.25,))
    plan, steps = Schedule.from_config(config), jnp.arange(24)
    assert (plan.total, plan.vae_training, plan.starts) == (64, ((0, 4), (16, 18)), 5)
    assert np.flatnonzero(plan.trains_vae(steps)).tolist() == [0, 1, 2, 3, 16, 17]
    assert np.flatnonzero(plan.replaces_encoder(steps)).tolist() == [3, 17]
    assert plan.replay_time(steps).tolist() == [*[0] * 4, *range(14), *range(6)]
    assert np.flatnonzero(learner_of(config).updates(config, plan.replay_time(steps))).tolist() == [*range(9, 18), 23]
    # Every step in which the VAE learns adds a row to its ring, and no other does.
    assert plan.samples_kept(config, steps).tolist() == [0, 1, 2, 3, *[4] * 13, 5, *[6] * 6]
    always = dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, keep_learning=True))
    assert plan.samples_kept(always, steps).tolist() == list(range(24))


def test_the_step_size_of_the_vae_changes_in_each_of_its_trainings_or_stays() -> None:
    config = retrained((0.25,))
    plan, falls = Schedule.from_config(config), {"learning_rate": 1e-3, "final_learning_rate": 2e-4}
    falling = dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, **falls))
    rates = [float(plan.vae_rate(falling, jnp.asarray(step))) for step in (0, 2, 3, 10, 16, 17)]
    np.testing.assert_allclose(rates, [1e-3, 6e-4, 4e-4, 1e-3, 1e-3, 6e-4], rtol=1e-5)
    stays = dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, learning_rate=3e-4))
    assert plan.vae_rate(stays, jnp.asarray(3)) == 3e-4


@pytest.mark.parametrize(
    ("retrain_at", "retrain_decisions", "times"),
    [
        ((0.01,), 32, ((0, 4), (11, 13))),  # not before the DQN has learnt for as long as it takes
        ((0.25, 0.26), 32, ((0, 4), (16, 18), (25, 27))),  # one after another
        ((0.25,), 10_000, ((0, 4), (17, 25))),  # an eighth of the run at most
        ((0.7,), 32, ((0, 4),)),  # too late for the DQN to learn again
    ],
)
def test_retrainings_leave_the_dqn_time(retrain_at, retrain_decisions, times) -> None:
    config = retrained(retrain_at)
    encoder = dataclasses.replace(config.encoder, retrain_decisions=retrain_decisions)
    assert Schedule.from_config(dataclasses.replace(config, encoder=encoder)).vae_training == times


@pytest.mark.parametrize("decisions", [10_000, 60_000, 100_000, 200_000, 874_000, 3_200_000])
def test_whatever_the_length_of_a_run_its_encoders_never_learn_at_once_or_in_vain(decisions: int) -> None:
    plan = Schedule.from_config(make_config("medium", train={"total_steps": decisions}))
    ends = [0]
    for first, end in plan.vae_training:
        assert ends[-1] <= first < end
        ends.append(end)
    assert plan.total - ends[-1] >= plan.total // 4 or len(plan.vae_training) == 1
    assert plan.vae_training[0] == (0, plan.warmup)


def test_totals_round_up_to_whole_chunks() -> None:
    config = dataclasses.replace(TINY, train=dataclasses.replace(TINY.train, total_steps=257))
    assert Schedule.from_config(config).total == 20
