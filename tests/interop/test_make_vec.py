"""`gymnasium.make_vec` makes what `gymnasium.make` makes, many times: its keywords, and its processes."""

from __future__ import annotations

import dataclasses
import multiprocessing
from typing import Any

import numpy as np
import pytest

import edqn_jax
from edqn_jax.devices import forks
from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.sim.actions import move_number
from edqn_jax.sim.task.outcomes import Outcome
from tests.support.interop.gym import small

gymnasium = require_extra("gymnasium", extra="gym")
interop = require_extra("edqn_jax.interop.gymnasium")

HOVER = int(move_number("hover"))
OPTIONS: dict[str, Any] = {"observation": "kinematics", "worlds": 2}


def made(count: int = 2, name: str = "EDQN/Random-v0", **options: Any) -> Any:
    return gymnasium.make_vec(name, num_envs=count, config=small(), **OPTIONS | options)


def ends(vector: Any, steps: int) -> list[int]:
    """Returns the steps of hovering drones, from 1, at which all of them are truncated."""
    vector.reset(seed=1)
    moves = np.full(vector.num_envs, HOVER)
    seen = [vector.step(moves) for _ in range(steps)]
    assert not any(np.any(terminated) for _, _, terminated, _, _ in seen)
    assert all(np.all(truncated) == np.any(truncated) for _, _, _, truncated, _ in seen)
    return [number for number, (_, _, _, truncated, _) in enumerate(seen, 1) if np.all(truncated)]


@pytest.mark.slow
def test_every_episode_is_cut_after_max_episode_steps():
    assert ends(made(max_episode_steps=5), 12) == [5, 11]  # the sixth step is spent on the reset
    assert ends(made(max_episode_steps=5, autoreset_mode="SameStep"), 12) == [5, 10]
    assert ends(made(max_episode_steps=5, vectorization_mode="sync"), 12) == [5, 11]


@pytest.mark.slow
def test_a_registered_limit_is_kept_and_another_one_takes_its_place():
    spec = dataclasses.replace(gymnasium.spec("EDQN/Random-v0"), id="Tests/Short-v0", max_episode_steps=3)
    gymnasium.registry[spec.id] = spec
    try:
        assert ends(made(name=spec.id), 7) == [3, 7]
        assert ends(made(name=spec.id, max_episode_steps=2), 5) == [2, 5]
        assert ends(made(name=spec.id, max_episode_steps=-1), 7) == []
    finally:
        del gymnasium.registry[spec.id]


@pytest.mark.slow
@pytest.mark.parametrize("limit", [9, -1, None])
def test_the_task_s_own_time_out_stays(limit):
    short = dataclasses.replace(small(), env=dataclasses.replace(small().env, max_decisions=3))
    vector = gymnasium.make_vec("EDQN/Random-v0", 2, config=short, max_episode_steps=limit, **OPTIONS)
    assert ends(vector, 7) == [3, 7]


def test_a_limited_vector_flies_and_says_what_limited_single_environments_do():
    options = {"config": small(), "max_episode_steps": 3, **OPTIONS}
    alone = [gymnasium.make("EDQN/Random-v0", **options) for _ in range(2)]
    vector = gymnasium.make_vec("EDQN/Random-v0", num_envs=2, **options)
    vector.reset(seed=4)
    for number, each in enumerate(alone):
        each.reset(seed=4 + number)
    for moves in np.random.default_rng(0).integers(0, 27, size=(3, 2)):
        observed, rewards, terminated, truncated, info = vector.step(moves)
        for number, each in enumerate(alone):
            seen, reward, *ended, about = each.step(moves[number])
            np.testing.assert_allclose(observed[number], seen, rtol=1e-5, atol=1e-5)
            assert reward == pytest.approx(rewards[number], rel=1e-4, abs=1e-4)
            assert ended == [terminated[number], truncated[number]]
    assert truncated.all() and info["_outcome"].all() and not info["is_success"].any()
    assert (
        [Outcome(int(number)).name.lower() for number in info["outcome"]] == [about["outcome"]] * 2 == ["running"] * 2
    )


@pytest.mark.parametrize("limit", [0, -2, 2.5, True, "5"])
def test_a_limit_that_is_none_is_refused(limit):
    with pytest.raises(ConfigError, match="max_episode_steps must be a whole number of at least 1, or -1"):
        made(max_episode_steps=limit)


def test_other_keywords_of_gymnasium_are_understood():
    assert isinstance(made(disable_env_checker=True), interop.DroneVectorEnv)
    assert isinstance(made(vectorization_mode="vector_entry_point"), interop.DroneVectorEnv)
    wrapped = made(vectorization_mode="sync", wrappers=[gymnasium.wrappers.RecordEpisodeStatistics])
    assert ends(wrapped, 3) == []
    assert isinstance(wrapped.envs[0], gymnasium.wrappers.RecordEpisodeStatistics)
    again = gymnasium.make_vec(made(max_episode_steps=2).spec)
    assert again.num_envs == 2 and ends(again, 2) == [2]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning", "ignore::UserWarning:gymnasium.*")  # of what it hands on
def test_processes_step_where_they_are_not_forked_and_say_so_where_they_are():
    modes = {"vectorization_mode": "async", "max_episode_steps": 2}
    vector = made(vector_kwargs={"context": "forkserver"}, **modes)
    assert ends(vector, 3) == [2]
    vector.close()
    forked = made(vector_kwargs={"context": "fork"}, **modes)
    with pytest.raises(ConfigError, match="forked after JAX had been used.*vector_kwargs={'context': 'forkserver'}"):
        forked.reset(seed=0)
    forked.close(terminate=True)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")
def test_what_a_pool_of_forked_processes_is_asked_for_is_refused():
    environment = edqn_jax.make("medium", small())
    environment.reset()
    with multiprocessing.get_context("fork").Pool(1) as pool:
        for function, argument in ((edqn_jax.make, "medium"), (environment.reset, 0), (edqn_jax.load_policy, "x")):
            with pytest.raises(ConfigError, match="start processes by 'forkserver' or 'spawn'"):
                pool.apply_async(function, (argument,)).get(timeout=60)


@pytest.mark.parametrize("name", ["make", "load_policy", "evaluate", "train", "train_seeds", "reset", "step"])
def test_everything_public_that_computes_is_refused_in_a_forked_process(monkeypatch, name):
    environment, policy = edqn_jax.make("medium", small()), edqn_jax.load_policy("pretrained")
    state, _ = environment.reset()
    calls = {
        "make": lambda: edqn_jax.make("medium"),
        "load_policy": lambda: edqn_jax.load_policy("pretrained"),
        "evaluate": lambda: edqn_jax.evaluate(policy),
        "train": lambda: edqn_jax.train(small()),
        "train_seeds": lambda: edqn_jax.train_seeds(2, small()),
        "reset": environment.reset,
        "step": lambda: environment.step(state, "ahead"),
    }
    monkeypatch.setattr(forks, "_without_threads", True)
    with pytest.raises(ConfigError, match="forked after JAX had been used"):
        calls[name]()
