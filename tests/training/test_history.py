"""What the host keeps of a run while it trains."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from edqn_jax.config import AgentConfig, Config, EncoderConfig, TrainConfig
from edqn_jax.errors import DivergedError
from edqn_jax.learn.plan import Plan
from edqn_jax.learn.trainer import Episodes, Losses
from edqn_jax.sim.outcomes import Outcome
from edqn_jax.training.history import EndedEpisodes, check_finite, chunk_metrics

PLAN = Plan(total=100, scheduled=100, warmup=4, starts=6, vae_training=((0, 4),))


def losses(*q_loss: float) -> Losses:
    blank = np.zeros(len(q_loss))
    fields = {field.name: blank for field in dataclasses.fields(Losses)} | {"q_loss": np.array(q_loss)}
    return Losses(**fields)  # type: ignore[arg-type]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_loss_that_is_not_finite_is_named_once_there_is_learning(bad: float) -> None:
    # A chunk of the steps 8 to 11; nothing is learnt in 8 and 9, whose loss is NaN.
    check_finite(PLAN, 12, losses(np.nan, np.nan, 0.5, 0.4), 3)
    with pytest.raises(DivergedError, match=f"the Q loss was {bad} at training step 12"):
        check_finite(PLAN, 12, losses(np.nan, np.nan, 0.5, bad), 3)
    with pytest.raises(DivergedError):
        check_finite(PLAN, 12, losses(np.nan, np.nan, bad, 0.5), 3)


def test_ended_episodes_are_those_with_an_outcome_counted_in_decisions_of_all_environments() -> None:
    outcome = np.zeros((2, 2, 3), int)  # two steps, two shards of three environments
    outcome[0, 1, 2], outcome[1, 0, 1] = Outcome.GOAL, Outcome.TIME_OUT
    numbers = np.arange(12).reshape(2, 2, 3)
    episodes = Episodes(outcome, 10 + numbers, 100.0 + numbers)  # type: ignore[arg-type]
    ended = EndedEpisodes.of(episodes, first=4, envs=6)
    assert ended.step.tolist() == [5 * 6, 6 * 6]
    assert ended.named() == ["goal", "time_out"]
    assert ended.length.tolist() == [15, 17] and ended.episode_return.tolist() == [105.0, 107.0]


def test_every_phase_of_a_run_has_its_name() -> None:
    # 64 steps of 16 environments: a warm-up of 16, a retraining in the 8 steps from 32 on.
    encoder = EncoderConfig(warmup_decisions=16 * 16, retrain_at=(0.5,), retrain_decisions=8 * 16)
    train = TrainConfig(num_envs=16, total_steps=64 * 16, chunk_steps=8)
    config = Config(encoder=encoder, agent=AgentConfig(learning_starts=64), train=train)
    assert Plan.of(config).vae_training == ((0, 16), (32, 40))
    ended = EndedEpisodes.of(Episodes(*np.zeros((3, 1, 1, 16), int)), first=0, envs=16)  # type: ignore[arg-type]
    chunks = [chunk_metrics(config, first, ended, losses(*[0.0] * 8), 1.0, 0) for first in range(0, 64, 8)]
    assert [chunk["phase"] for chunk in chunks] == ["warm-up"] * 2 + ["training"] * 2 + ["retraining"] + [
        "training"
    ] * 3
