"""The streams of a run, and integers from single draws of bits."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.cli.train import parse_train
from edqn_jax.evaluation.missions import mission_key, run_missions
from edqn_jax.evaluation.rollouts import flight_keys
from edqn_jax.keys import run_streams, uniform_integers
from edqn_jax.learn.state import InitialKeys, init_state
from edqn_jax.learn.step import ShardKeys
from edqn_jax.sim.task import env
from edqn_jax.sim.worlds import families
from tests.support.miniature import MINIATURE


@pytest.mark.parametrize("below", [1, 2, 27, 1000])
def test_integers_are_uniform_below_their_bound(below: int) -> None:
    count = 200_000
    drawn = np.asarray(uniform_integers(jax.random.key(3), (count,), below))
    assert drawn.dtype == np.int32 and drawn.min() >= 0 and drawn.max() < below
    counts = np.bincount(drawn, minlength=below)
    # Pearson's statistic has mean below - 1 and variance twice that; five deviations.
    statistic = np.sum((counts - count / below) ** 2) / (count / below)
    assert abs(statistic - (below - 1)) <= 5 * np.sqrt(2 * (below - 1))


def test_each_integer_has_its_own_bound() -> None:
    bounds = jnp.asarray([1, 5, 100, 2**31 - 1])
    drawn = np.asarray(uniform_integers(jax.random.key(0), (5000, 4), bounds))
    assert (drawn >= 0).all() and (drawn < np.asarray(bounds)).all()
    assert drawn[:, 1].max() == 4 and drawn[:, 2].max() == 99 and drawn[:, 3].max() > 2**30


def keys_of_a_run(seed: int) -> dict[str, jax.Array]:
    """The keys of every stream that a run with this seed draws from, each [n], as the run derives them."""
    streams = run_streams(seed)
    initial = InitialKeys.split(streams.learning, envs=64, shards=8)
    environments, loop = flight_keys(streams.flights, 64)
    steps = ShardKeys.split(initial.shards)
    return {
        "training missions": jax.random.split(streams.training_missions, 3),
        "validation missions": jax.random.split(streams.validation_missions, 3),
        "parameters": jax.random.split(initial.learner, 2),
        "environments": jax.vmap(lambda key: jax.random.split(key, 3))(initial.environments).ravel(),
        "shards": jnp.concatenate(list(steps)),
        "flights": jax.vmap(lambda key: jax.random.split(key, 3))(environments).ravel(),
        "flights' loop": jax.random.split(loop, 3),
        "roots": jnp.stack([*streams, initial.learner, loop]),
        "first keys of environments and shards": jnp.concatenate([initial.environments, initial.shards, environments]),
        **{f"{split} worlds": families.world_keys(split, 64) for split in families.SPLITS},
        "evaluation missions": jnp.stack([mission_key(number) for number in range(64)]),
    }


# 2024 and 7919 are the seeds of the roots of worlds and of evaluation missions.
@pytest.mark.parametrize("seed", [0, 1, 2024, 7919])
@pytest.mark.slow
def test_no_two_streams_of_a_run_are_equal(seed: int) -> None:
    owners: dict[bytes, str] = {}
    for stream, keys in keys_of_a_run(seed).items():
        for number, key in enumerate(np.asarray(jax.random.key_data(keys)).reshape(-1, 2)):
            other = owners.setdefault(key.tobytes(), f"{stream} {number}")
            assert other == f"{stream} {number}"


def test_runs_of_two_seeds_share_no_stream_but_worlds_and_evaluation_missions() -> None:
    shared = {*(f"{split} worlds" for split in families.SPLITS), "evaluation missions"}
    first, second = keys_of_a_run(0), keys_of_a_run(1)
    for stream in first.keys() - shared:
        data = [{key.tobytes() for key in np.asarray(jax.random.key_data(run[stream]))} for run in (first, second)]
        assert not data[0] & data[1], stream


@pytest.mark.whole
@pytest.mark.slow
def test_a_run_derives_its_keys_from_its_streams_alone() -> None:
    """The environments of a run begin with the keys of the list above."""
    config = parse_train(MINIATURE)[1]
    world = run_missions(config).training.env_params
    state = jax.jit(lambda key: init_state(config, world, key))(run_streams(5).learning)
    initial = InitialKeys.split(run_streams(5).learning, config.train.num_envs, config.train.shards)
    begun = jax.vmap(lambda key: env.before_reset(config, world, key))(initial.environments)
    np.testing.assert_array_equal(
        jax.random.key_data(state.actors.env.key).reshape(-1, 2), jax.random.key_data(begun.key)
    )
    np.testing.assert_array_equal(jax.random.key_data(state.actors.key), jax.random.key_data(initial.shards))
