"""What the host keeps of a run while it trains."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from edqn_jax.config import AgentConfig, Config, EncoderConfig, TrainConfig
from edqn_jax.errors import DivergedError
from edqn_jax.learn.learner import RUN_METRICS
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.state import Episodes, Losses
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.training.history import DivergenceMonitor, EndedEpisodes, chunk_metrics, mean_metrics
from tests.support.miniature import no_losses

PLAN = Schedule(total=100, scheduled=100, warmup=4, starts=6, vae_training=((0, 4),))


CONFIG = Config(
    encoder=EncoderConfig(warmup_updates_per_step=2),
    agent=AgentConfig(updates_per_step=4, learning_starts=48),
    train=TrainConfig(num_envs=8, chunk_steps=40, seed=3),
)


def ill(step: int = 0, **counts: int) -> Losses:
    """Losses of 40 training steps in each of which, from `step` on, these quantities were not finite."""
    found = no_losses(40)
    health = {name: np.where(np.arange(40) >= step, count, 0) for name, count in counts.items()}
    return dataclasses.replace(found, health=dataclasses.replace(found.health, **health))


@pytest.mark.parametrize(
    ("first", "then", "says"),
    [
        ({"parameters": 1, "loss": 4, "gradient": 4}, {}, "NaN or Inf in the parameters at training step 120"),
        ({"loss": 4, "gradient": 4}, {"parameters": 1}, "NaN or Inf in the loss at training step 120"),
        ({"gradient": 4}, {}, "NaN or Inf in the gradient at training step 120"),
        ({"physics_state": 4, "reward": 1}, {}, "NaN or Inf in the physics state at training step 120"),
        ({"observation": 3}, {"physics_state": 8}, "NaN or Inf in the observation at training step 120"),
        ({"reward": 4}, {}, "NaN or Inf in the reward at training step 120"),
    ],
)
def test_what_learns_nothing_for_a_hundred_steps_is_given_up_and_what_spoilt_it_is_named(
    first: dict[str, int], then: dict[str, int], says: str
) -> None:
    watch = DivergenceMonitor()
    watch.check(PLAN, CONFIG, 120, no_losses(40))
    watch.check(PLAN, CONFIG, 160, ill(**first))
    watch.check(PLAN, CONFIG, 200, ill(**(first | then)))
    with pytest.raises(DivergedError, match=f"seed 3 diverged: {says}, and nothing was learnt in 120 training steps"):
        watch.check(PLAN, CONFIG, 240, ill(**(first | then)))


@pytest.mark.parametrize(
    "mild", [{"loss": 3, "gradient": 3}, {"physics_state": 1}, {"reward": 1}, {"gradient": 4, "step": 1}]
)
def test_what_still_learns_goes_on(mild: dict[str, int]) -> None:
    watch = DivergenceMonitor()
    for done in range(120, 600, 40):
        watch.check(PLAN, CONFIG, done, ill(**mild))
    for done in range(600, 1200, 80):  # ill chunks, but never in a row
        watch.check(PLAN, CONFIG, done, ill(gradient=4))
        watch.check(PLAN, CONFIG, done + 40, ill(**mild))


def test_an_idle_warm_up_is_not_ill() -> None:
    plan = dataclasses.replace(PLAN, total=1000, warmup=900, vae_training=())
    for done in range(40, 800, 40):
        DivergenceMonitor().check(plan, CONFIG, done, no_losses(40))


def test_what_diverged_is_counted_and_not_averaged() -> None:
    outcome = np.array([[[Outcome.GOAL, Outcome.DIVERGED]]])
    episodes = Episodes(outcome, np.ones((1, 1, 2), int), np.array([[[8.0, 999.0]]]))  # type: ignore[arg-type]
    ended = EndedEpisodes.from_chunk(episodes, first=0, envs=2)
    found = chunk_metrics(CONFIG, 0, ended, ill(gradient=2), 1.0, 2)
    assert (found["diverged"], found["mean_return"], found["success_rate"]) == (1, 8.0, 0.5)
    assert found["skipped_updates"] == 80
    of_validation = {f"validation_{name}" for name in ("success", "mission", "spl", "timed_out")}
    assert of_validation | set(found) == {*RUN_METRICS, *ill().metrics}


def test_ended_episodes_are_those_with_an_outcome_counted_in_decisions_of_all_environments() -> None:
    outcome = np.zeros((2, 2, 3), int)  # two steps, two shards of three environments
    outcome[0, 1, 2], outcome[1, 0, 1] = Outcome.GOAL, Outcome.TIME_OUT
    numbers = np.arange(12).reshape(2, 2, 3)
    episodes = Episodes(outcome, 10 + numbers, 100.0 + numbers)  # type: ignore[arg-type]
    ended = EndedEpisodes.from_chunk(episodes, first=4, envs=6)
    assert ended.step.tolist() == [5 * 6, 6 * 6]
    assert ended.outcome_names() == ["goal", "time_out"]
    assert ended.length.tolist() == [15, 17] and ended.episode_return.tolist() == [105.0, 107.0]


def test_every_phase_of_a_run_has_its_name() -> None:
    # 64 steps of 16 environments: a warm-up of 16, a retraining in the 8 steps from 32 on.
    encoder = EncoderConfig(warmup_decisions=16 * 16, retrain_at=(0.5,), retrain_decisions=8 * 16)
    train = TrainConfig(num_envs=16, total_steps=64 * 16, chunk_steps=8)
    config = Config(encoder=encoder, agent=AgentConfig(learning_starts=64), train=train)
    assert Schedule.from_config(config).vae_training == ((0, 16), (32, 40))
    ended = EndedEpisodes.from_chunk(Episodes(*np.zeros((3, 1, 1, 16), int)), first=0, envs=16)  # type: ignore[arg-type]
    chunks = [chunk_metrics(config, first, ended, no_losses(8), 1.0, 0) for first in range(0, 64, 8)]
    assert [chunk["phase"] for chunk in chunks] == ["warm-up"] * 2 + ["training"] * 2 + ["retraining"] + [
        "training"
    ] * 3


def test_what_is_shown_of_several_agents_is_their_mean() -> None:
    first = {"phase": "training", "decisions": 64, "success_rate": 0.5, "q_loss": None, "warm_up": None}
    second = {"phase": "training", "decisions": 64, "success_rate": None, "q_loss": 0.1, "warm_up": None}
    third = {"phase": "training", "decisions": 64, "success_rate": 0.7, "q_loss": 0.3, "warm_up": None}
    mean = mean_metrics([first, second, third])
    assert mean == {
        "phase": "training",
        "decisions": 64.0,
        "success_rate": pytest.approx(0.6),
        "q_loss": pytest.approx(0.2),
        "warm_up": None,
    }
    assert mean_metrics([first]) is first
