"""Training of several drones in one world: what is learnt from, and what is not."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.learn import replay
from edqn_jax.learn.state import init_state
from edqn_jax.learn.step import train_step
from edqn_jax.sim.task.outcomes import Outcome

pytestmark = pytest.mark.whole

STEPS = 40


def configured(**groups) -> Config:
    small = {
        "world": {"pool_size": 4, "missions": 32, "flown": ""},
        "drone": {"physics": "rigid_body"},
        "camera": {"width": 8, "height": 6},
        "env": {"drones": 2, "max_decisions": 30},
        "encoder": {
            "code_size": 4,
            "patch_layers": (8, 4),
            "joint_layers": (16,),
            "decoder_hidden": (16,),
            "warmup_decisions": 64,
            "warmup_updates_per_step": 1,
            "batch_size": 16,
            "replay_size": 1024,
            "retrain_at": (),
            "keep_learning": True,
        },
        "agent": {
            "hidden": (16,),
            "batch_size": 16,
            "updates_per_step": 1,
            "learning_starts": 64,
            "replay_size": 1024,
            "exploration_end": 1.0,
        },
        "train": {"num_envs": 16, "shards": 2, "chunk_steps": 4, "total_steps": 16 * STEPS, "validation_missions": 8},
    }
    both: Any = {name: {**small.get(name, {}), **groups.get(name, {})} for name in {*small, *groups}}
    return make_config("dense", **both)


@pytest.fixture(scope="module")
def trained():
    """A state after training, and of each step whether its environments [E] waited, and what ended."""
    config = configured()
    world = run_missions(config).training.env_params
    state = jax.jit(partial(init_state, config, world))(jax.random.key(0))

    def one(state, step):
        after, (episodes, losses) = train_step(config, world, None, state, step)
        waited = after.actors.env.ended & (after.actors.outcome == Outcome.TIME_OUT) & after.actors.is_reset
        return after, (waited, episodes, losses)

    state, found = jax.jit(lambda state: jax.lax.scan(one, state, jnp.arange(STEPS)))(state)
    return config, state, jax.tree.map(np.asarray, found)


def test_training_with_several_drones_learns_and_drones_wait_for_the_others(trained):
    _, state, (waited, episodes, losses) = trained
    share = waited.mean()
    assert 0.02 < share < 0.6  # random manoeuvres in dense worlds end early, at different times
    assert np.isfinite(losses.metrics["q_loss"][-1]) and np.isfinite(losses.metrics["reconstruction_loss"][-1])
    assert int(losses.health.gradient.sum()) == 0 and int(state.step) == STEPS


def test_what_waits_is_no_episode(trained):
    _, state, (waited, episodes, _) = trained
    assert (episodes.outcome[waited] == Outcome.RUNNING).all()
    # An environment that has ended ends again only after a reset of its group: two ends in a row are never of one.
    ends = (episodes.outcome != Outcome.RUNNING).reshape(STEPS, -1)
    assert 10 < ends.sum() and not (ends[1:] & ends[:-1]).any()
    counted = ends[4:].sum(0)  # 64 decisions of warm-up
    assert np.array_equal(np.asarray(state.actors.episodes).ravel(), counted)


def test_no_row_of_a_drone_that_waits_is_in_a_sample_of_the_replay(trained):
    config, state, (waited, *_) = trained
    ring, time = jax.tree.map(lambda x: x[0], state.actors.replay), STEPS - 1 - 4  # since the warm-up's end
    length = ring.reward.shape[0]
    # A row holds what arriving brought: that of the step before.
    rows = np.zeros((length, 8), bool)
    for row in range(time + 1):
        rows[row % length] = waited[row + 4 - 1, 0]
    assert rows.sum() > 10 and np.array_equal(
        rows[: time + 1], np.asarray(ring.is_reset & (ring.outcome != 0))[: time + 1]
    )
    spoilt = dataclasses.replace(
        ring,
        observation=jnp.where(rows[..., None], 1e6, ring.observation),
        reward=jnp.where(rows, 1e6, ring.reward),
    )
    every = [(t, e) for t in range(config.agent.n_step, time - config.agent.history) for e in range(8)]
    ages, envs = (jnp.array(x) for x in zip(*every, strict=True))
    transition = jax.jit(
        jax.vmap(lambda ring, age, env: replay._transition(config.agent, ring, time - age, env), (None, 0, 0))
    )
    batch, other = (jax.tree.map(np.asarray, transition(each, ages, envs)) for each in (ring, spoilt))
    used = batch.weight > 0
    starts = rows[(time - np.asarray(ages)) % length, np.asarray(envs)]
    assert used.sum() > 50 and starts.sum() > 5 and not (used & starts).any()
    assert not np.array_equal(batch.history, other.history)
    for read, unchanged in zip(jax.tree.leaves(batch), jax.tree.leaves(other), strict=True):
        assert np.array_equal(read[used], unchanged[used])


def test_the_encoder_is_given_what_a_mate_saw_in_place_of_what_a_drone_that_waits_sees(trained):
    _, state, (waited, *_) = trained
    rings, pairs = state.actors.samples, 0
    motion = np.asarray(rings.motion)  # [S, L, E, 7]
    for step in range(1, STEPS):
        for shard in range(2):
            for env in np.flatnonzero(waited[step, shard]):
                assert np.array_equal(motion[shard, step, env], motion[shard, step, env ^ 1])
                pairs += 1
    assert pairs > 10


@pytest.mark.parametrize(
    ("groups", "said"),
    [
        ({"env": {"drones": 9}}, "env.drones must be from 1 to 8, not 9"),
        (
            {"env": {"drones": 8}, "train": {"num_envs": 24}},
            "train.num_envs must be a multiple of 16 with env.drones 8, not 24",
        ),
        (
            {"train": {"validation_missions": 9}},
            "train.validation_missions must be a multiple of 2 with env.drones 2, not 9",
        ),
        ({"world": {"missions": 33}}, "world.missions must be a multiple of 2 with env.drones 2, not 33"),
        ({"world": {"balls": 1}}, "world.balls must be 0 with env.drones 2: balls are thrown at one drone, not 1"),
        (
            {"env": {"drones": 2, "reward": "geodesic"}},
            "env.reward must be sparse, progress or potential with env.drones 2",
        ),
        ({"train": {"debug": True, "devices": 1}}, "train.debug must be false with env.drones 2, not True"),
    ],
)
def test_what_several_drones_cannot_do_is_refused_in_a_sentence(groups, said):
    with pytest.raises(ConfigError, match=said):
        configured(**groups)


def test_a_world_from_a_file_is_refused():
    with pytest.raises(ConfigError, match=r"^world.name must be a random world \(.*\) with env.drones 2, not 'paper'$"):
        make_config("paper", env={"drones": 2})
