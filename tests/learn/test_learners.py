"""The contract of learners: PQN in the real training step, a learner of one's own, and names that there are not."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.config.registry import LEARNERS
from edqn_jax.config.rules import validate
from edqn_jax.errors import ConfigError
from edqn_jax.learn.dqn.learner import DQN
from edqn_jax.learn.learner import Learner, UpdateStats, learner_of
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.state import init_state
from edqn_jax.learn.step import policy_of, run_steps
from tests.support.miniature import miniature_world

pytestmark = pytest.mark.whole

STEPS = 24


def miniature(learner: str) -> Config:
    return make_config(
        "paper",
        camera={"width": 8, "height": 6},
        drone={"physics": "rigid_body"},
        encoder={"warmup_decisions": 64, "batch_size": 16, "replay_size": 512},
        agent={"learner": learner, "batch_size": 16, "replay_size": 512, "learning_starts": 64},
        pqn={"rollout": 4, "epochs": 2, "minibatches": 2},
        train={"num_envs": 16, "chunk_steps": 8, "total_steps": 16 * 64},
        world={"missions": 16},
    )


def trained(config: Config):
    world = miniature_world(config)
    before = jax.jit(lambda key: init_state(config, world, key))(jax.random.key(0))
    after, (_, losses) = jax.jit(lambda s: run_steps(config, world, s, jnp.arange(STEPS)))(before)
    return before, after, losses


def moved(before, after) -> bool:
    pairs = zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True)
    return any(np.any(np.asarray(a) != np.asarray(b)) for a, b in pairs)


@pytest.mark.slow
def test_pqn_learns_at_the_end_of_each_rollout_in_the_step_that_trains_dqn():
    config = miniature("pqn")
    before, after, losses = trained(config)
    plan = Schedule.from_config(config)
    steps = np.arange(STEPS)
    due = np.asarray(learner_of(config).updates(config, plan.replay_time(steps))) * (steps >= plan.warmup)
    assert plan.warmup == 4 and np.flatnonzero(due).tolist() == [9, 13, 17, 21] and set(due[due > 0]) == {4}
    np.testing.assert_array_equal(np.isfinite(losses.metrics["q_loss"]), due > 0)
    assert moved(before.learner.agent.q, after.learner.agent.q)
    assert moved(before.learner.agent.average, after.learner.agent.average)
    assert all(np.isfinite(leaf).all() for leaf in map(np.asarray, jax.tree.leaves(after.learner.agent)))


@pytest.mark.slow
def test_a_learner_of_ones_own_is_trained_by_its_name_without_a_change_to_the_package():
    def hover(config, state, memory, keys, progress):
        return jnp.full(memory.shape[:2], 13), {"height_of_hover": jnp.float32(1.0)}

    def count(config, axis, state, rings, after):
        return UpdateStats.without_updates("count"), state | {"count": state["count"] + 1}

    mine = Learner(
        init=lambda config, key: {"q": DQN.init(config, key).q, "count": jnp.int32(0)},
        act=hover,
        decide=DQN.decide,
        ring_length=lambda config: 2,
        starts=lambda config: 1,
        updates=lambda config, newest: jnp.zeros_like(newest),
        update=count,
        network=lambda state: state["q"],
        policy=lambda state: state["q"],
    )
    LEARNERS.register("hovering", mine)
    config = miniature("hovering")
    validate(config)
    _, after, losses = trained(config)
    assert after.learner.agent["count"] == STEPS
    assert losses.metrics["height_of_hover"][-1] == 1.0 and "epsilon" not in losses.metrics
    assert policy_of(config, after).q is after.learner.agent["q"]


def test_a_learner_that_there_is_not_is_answered_with_the_nearest():
    config = make_config("paper")
    wrong = dataclasses.replace(config, agent=dataclasses.replace(config.agent, learner="pqm"))
    with pytest.raises(ConfigError, match="agent.learner: there is no learner 'pqm'; did you mean 'pqn'?"):
        validate(wrong)
