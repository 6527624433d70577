"""`train`: a policy and its history without a folder, a reward and a callback of one's own."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.learn.policy import Policy, PolicyParams
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.reward import Transition
from edqn_jax.training.loop import Chunk, TrainingResult, train
from tests.support.configs import BLIND_RUN

CHUNK = BLIND_RUN.train.num_envs * BLIND_RUN.train.chunk_steps
"""Decisions."""

pytestmark = [pytest.mark.slow, pytest.mark.whole]


def one(transition: Transition) -> jax.Array:
    """The same for every decision, whatever the configuration asks for."""
    del transition
    return jnp.ones(())


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[TrainingResult, list[Chunk], list[Path]]:
    """What was trained to its end, what the callback was given, and what stands in the folder where it was done."""
    chunks: list[Chunk] = []
    folder = tmp_path_factory.mktemp("here")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        result = train(BLIND_RUN, reward=one, callback=chunks.append)
    return result, chunks, list(folder.iterdir())


def test_training_returns_policy_and_history_and_writes_nothing(trained) -> None:
    result, chunks, written = trained
    assert written == []
    assert not result.stopped and result.decisions == BLIND_RUN.train.total_steps
    assert [row["decisions"] for row in result.history.metrics] == list(
        range(CHUNK, BLIND_RUN.train.total_steps + 1, CHUNK)
    )
    assert [chunk.metrics for chunk in chunks] == result.history.metrics
    assert [chunk.episodes for chunk in chunks] == result.history.episodes
    # It ends with a validation, and with the parameters that were validated.
    assert [decisions for decisions, *_ in result.history.validations] == [BLIND_RUN.train.total_steps]
    assert result.kept.decisions == BLIND_RUN.train.total_steps and result.kept is chunks[-1].kept
    assert result.policy.config == BLIND_RUN
    assert same(result.policy.params, result.kept.params)


def test_a_reward_of_ones_returns_the_length_of_each_episode(trained) -> None:
    episodes = trained[0].history.episodes
    outcomes, returns, lengths = (
        np.concatenate([getattr(ended, name) for ended in episodes]) for name in ("outcome", "episode_return", "length")
    )
    assert len(outcomes) >= BLIND_RUN.train.num_envs and Outcome.DIVERGED not in outcomes
    assert len(set(lengths)) > 1
    np.testing.assert_array_equal(returns, lengths)


def test_a_callback_that_returns_true_stops_after_its_chunk(trained) -> None:
    newest: list[Policy] = []

    def second(chunk: Chunk) -> bool:
        newest.append(chunk.policy())
        return chunk.metrics["decisions"] == 2 * CHUNK

    result = train(BLIND_RUN, reward=one, callback=second)
    assert result.stopped and result.decisions == 2 * CHUNK
    # The same training as far as it went, and nothing validated: it ends with what it has come to.
    for ours, whole in zip(result.history.episodes, trained[0].history.episodes[:2], strict=True):
        np.testing.assert_array_equal(ours.length, whole.length)
    assert len(newest) == 2 and result.history.validations == []
    assert same(result.policy.params, newest[-1].params)


def same(one: PolicyParams, two: PolicyParams) -> bool:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)
