"""What the host keeps of a run while it trains."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from edqn_jax.errors import DivergedError
from edqn_jax.learn.trainer import Episodes, Losses, Plan
from edqn_jax.sim.outcomes import Outcome
from edqn_jax.training.history import EndedEpisodes, check_finite

PLAN = Plan(total=100, warmup=4, starts=6, lessons=((0, 4),))


def losses(*q_loss: float) -> Losses:
    blank = np.zeros(len(q_loss))
    fields = {field.name: blank for field in dataclasses.fields(Losses)} | {"q_loss": np.array(q_loss)}
    return Losses(**fields)  # type: ignore[arg-type]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_loss_that_is_not_finite_is_named_once_there_is_learning(bad: float) -> None:
    # A chunk of the steps 8 to 11; nothing is learnt in 8 and 9, whose loss is NaN.
    check_finite(PLAN, 12, losses(np.nan, np.nan, 0.5, 0.4))
    with pytest.raises(DivergedError, match=f"the Q loss was {bad} at training step 12"):
        check_finite(PLAN, 12, losses(np.nan, np.nan, 0.5, bad))
    with pytest.raises(DivergedError):
        check_finite(PLAN, 12, losses(np.nan, np.nan, bad, 0.5))


def test_ended_episodes_are_those_with_an_outcome_counted_in_decisions_of_all_environments() -> None:
    outcome = np.zeros((2, 2, 3), int)  # two steps, two shards of three environments
    outcome[0, 1, 2], outcome[1, 0, 1] = Outcome.GOAL, Outcome.TIME_OUT
    numbers = np.arange(12).reshape(2, 2, 3)
    episodes = Episodes(outcome, 10 + numbers, 100.0 + numbers)  # type: ignore[arg-type]
    ended = EndedEpisodes.of(episodes, first=4, envs=6)
    assert ended.step.tolist() == [5 * 6, 6 * 6]
    assert ended.named() == ["goal", "time_out"]
    assert ended.length.tolist() == [15, 17] and ended.episode_return.tolist() == [105.0, 107.0]
