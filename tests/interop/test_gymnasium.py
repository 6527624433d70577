"""Gymnasium's environments are the same task, and obey its rules."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import edqn_jax
from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.learn.actor import AgentActor
from edqn_jax.sim.actions import move_number
from edqn_jax.sim.task.observation import OWN_SIZE
from edqn_jax.sim.task.outcomes import Outcome
from tests.support.interop.gym import DOWN, HOVER, MOVES, many, policy, small

gymnasium = require_extra("gymnasium", extra="gym")
interop = require_extra("edqn_jax.interop.gymnasium")

AHEAD = int(move_number("ahead"))


def one(**options: Any) -> Any:
    return interop.DroneEnv("medium", small(), worlds=3, **options)


def counts(image: np.ndarray) -> np.ndarray:
    """Returns the signed numbers of events that an observed image stands for."""
    return np.sign(image) * np.expm1(np.abs(image))


@pytest.mark.filterwarnings("ignore:.*unconventional shape")  # an image [H, W], which the library flattens
@pytest.mark.parametrize("observation", ["image", "kinematics"])
def test_it_passes_the_checks_of_gymnasium_and_of_stable_baselines3(observation):
    options = {"config": small(), "worlds": 3, "observation": observation, "render_mode": "rgb_array"}
    checked = gymnasium.make("EDQN/Random-v0", **options).unwrapped
    require_extra("gymnasium.utils.env_checker").check_env(checked)
    require_extra("stable_baselines3.common.env_checker").check_env(checked)


@pytest.mark.parametrize(("name", "world"), [("Paper", "paper"), ("Random", "medium")])
def test_it_is_made_by_its_name(name, world):
    made = gymnasium.make(f"EDQN/{name}-v0", observation="kinematics")
    assert made.unwrapped.task.config.world.name == world
    vector = gymnasium.make_vec(f"EDQN/{name}-v0", num_envs=2, observation="kinematics")
    assert isinstance(vector, interop.DroneVectorEnv) and vector.num_envs == 2
    assert vector.task.environment.missions == made.unwrapped.task.environment.missions


def test_the_same_moves_fly_as_with_the_pure_functions():
    made, pure = one(), edqn_jax.make("medium", small(), worlds=3)
    observed, _ = made.reset(seed=4, options={"mission": 1})
    state, seen = pure.reset(4, 1)
    for move in MOVES[:, 0]:
        np.testing.assert_array_equal(observed["own"], np.clip(seen.own, -10, 10))
        np.testing.assert_array_equal(observed["motion"], np.clip(seen.motion, -10, 10))
        seen_counts = pure.event_image(seen)
        np.testing.assert_allclose(counts(observed["image"]), seen_counts, atol=1e-3)
        observed, reward, terminated, truncated, info = made.step(move)
        state, step = pure.step(state, move)
        seen = step.observation
        assert reward == step.reward
        assert (terminated or truncated) == (step.outcome != Outcome.RUNNING)
        assert info["outcome"] == Outcome(int(step.outcome)).name.lower()
        np.testing.assert_array_equal(made.drone.state.drone.position, state.drone.position)
        if terminated or truncated:
            break
    else:
        assert np.any(seen_counts), "the flight saw no event, so images were not compared"


def test_every_drone_of_a_vector_flies_as_one_alone():
    vector, alone = many(), [one() for _ in range(3)]
    observed, _ = vector.reset(seed=7)
    firsts = [each.reset(seed=7 + number)[0] for number, each in enumerate(alone)]
    running = [True] * 3
    for moves in MOVES:
        for number in np.flatnonzero(running):
            for name in ("own", "motion"):
                np.testing.assert_allclose(observed[name][number], firsts[number][name], rtol=1e-5, atol=1e-5)
            # Two programs round differently, and a brightness at a threshold makes an event or none.
            apart = np.abs(counts(observed["image"][number]) - counts(firsts[number]["image"]))
            assert apart.max() < 1.01 and np.mean(apart > 0.5) < 0.03
        observed, rewards, terminated, truncated, _ = vector.step(moves)
        for number in np.flatnonzero(running):
            firsts[number], reward, *ended, _ = alone[number].step(moves[number])
            assert reward == pytest.approx(rewards[number], rel=1e-4, abs=1e-4)
            assert ended == [terminated[number], truncated[number]]
            running[number] = not any(ended)


def test_an_ended_drone_spends_its_next_step_on_being_reset():
    vector = many(2)
    vector.reset(seed=0)
    while True:
        _, rewards, terminated, truncated, info = vector.step(np.array([DOWN, 0]))
        if terminated[0]:
            break
    assert not truncated[0] and Outcome(int(info["outcome"][0])) is not Outcome.RUNNING
    assert info["_outcome"].tolist() == [True, bool(terminated[1])] and not info["is_success"][0]
    observed, rewards, terminated, truncated, info = vector.step(np.array([DOWN, 0]))
    assert rewards[0] == 0.0 and not terminated[0] and not truncated[0]
    assert not observed["motion"][0].any()  # at rest, with no last move
    _, rewards, *_ = vector.step(np.array([DOWN, 0]))
    assert rewards[0] != 0.0


@pytest.mark.parametrize("mode", ["SameStep", gymnasium.vector.AutoresetMode.SAME_STEP])
def test_an_ended_drone_can_be_reset_in_the_same_step(mode):
    options = {"config": small(), "worlds": 1, "observation": "kinematics"}
    vector = gymnasium.make_vec("EDQN/Random-v0", num_envs=2, autoreset_mode=mode, **options)
    assert vector.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    assert many().metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.NEXT_STEP
    first, _ = vector.reset(seed=0)
    while True:
        observed, rewards, terminated, truncated, info = vector.step(np.array([DOWN, HOVER]))
        if terminated[0]:
            break
        assert not info
    assert not terminated[1] and not truncated.any()
    assert rewards[0] != 0.0 and info["_final_obs"].tolist() == info["_final_info"].tolist() == [True, False]
    np.testing.assert_allclose(observed[0], first[0], rtol=1e-5, atol=1e-5)  # the only mission once more
    assert info["final_obs"][1] is None and info["final_obs"][0][-1] == -1.0  # the last move was down
    assert Outcome(int(info["final_info"]["outcome"][0])) is not Outcome.RUNNING
    assert not info["final_info"]["is_success"][0]


def test_time_out_truncates_and_the_goal_terminates():
    short = dataclasses.replace(small(), env=dataclasses.replace(small().env, max_decisions=2))
    hovering = interop.DroneEnv("medium", short, observation="kinematics")
    hovering.reset(seed=0)
    hover = int(move_number("hover"))
    assert hovering.step(hover)[2:4] == (False, False)
    *_, terminated, truncated, info = hovering.step(hover)
    assert (terminated, truncated, info) == (False, True, {"outcome": "time_out", "is_success": False})
    near = dataclasses.replace(small(), env=dataclasses.replace(small().env, goal_radius_m=500.0))
    arriving = interop.DroneEnv("medium", near, observation="kinematics")
    arriving.reset(seed=0)
    *_, terminated, truncated, info = arriving.step(hover)
    assert (terminated, truncated, info) == (True, False, {"outcome": "goal", "is_success": True})


def test_a_code_is_that_of_the_policy():
    flown = policy()
    made = interop.DroneEnv("medium", observation="code", policy=flown, worlds=3)
    pure = edqn_jax.make("medium", flown.config, worlds=3)
    observed, _ = made.reset(seed=1, options={"mission": 2})
    state, seen = pure.reset(1, 2)
    empty = jnp.zeros((1, flown.config.encoder.code_size + OWN_SIZE))
    memory = empty
    for move in MOVES[:4, 0]:
        memory = AgentActor(flown.config).encode(flown.params, memory, seen)
        expected = jnp.concatenate([memory[-1], seen.motion])
        np.testing.assert_allclose(observed, np.clip(expected, -10, 10), rtol=1e-5, atol=1e-6)
        observed, *_ = made.step(move)
        state, step = pure.step(state, move)
        seen = step.observation


def test_what_is_returned_may_be_written():
    vector = many(2)
    observed, _ = vector.reset(seed=0)
    stepped, rewards, *_ = vector.step(np.zeros(2, int))
    for array in (*observed.values(), *stepped.values(), rewards):
        array += 1.0


def test_missions_and_worlds_can_be_chosen():
    vector, pure = many(3, observation="kinematics"), edqn_jax.make("medium", small(), worlds=3)
    vector.reset(options={"mission": [2, 0, 1]})
    starts = np.asarray(pure.world.missions.start)
    np.testing.assert_array_equal(vector.drones.state.drone.position, starts[[2, 0, 1]])
    vector.reset(options={"mission": 1})
    np.testing.assert_array_equal(vector.drones.state.drone.position, starts[[1, 1, 1]])
    others = interop.DroneEnv("medium", small(), worlds=3, world_seed=1, observation="kinematics")
    expected = edqn_jax.make("medium", small(), worlds=3, seed=1)
    np.testing.assert_array_equal(others.task.environment.world.pool.start, expected.world.pool.start)
    assert np.any(expected.world.pool.start != pure.world.pool.start)


def test_any_seed_of_gymnasium_is_one():
    made, vector = one(observation="kinematics"), many(2, observation="kinematics")
    large, _ = made.reset(seed=2**40 + 3)
    np.testing.assert_array_equal(large, made.reset(seed=3)[0])
    together, _ = vector.reset(seed=2**32 - 1)
    np.testing.assert_allclose(together[1], made.reset(seed=0)[0], rtol=1e-5, atol=1e-5)


def test_pictures_show_what_a_person_would_see():
    made = one(render_mode="rgb_array")
    made.reset(seed=0)
    picture = made.render()
    assert picture.shape == (96, 128, 3) and picture.dtype == np.uint8 and picture.std() > 5
    vector = many(2, render_mode="rgb_array")
    vector.reset(seed=0)
    pictures = vector.render()
    assert len(pictures) == 2
    np.testing.assert_array_equal(pictures[0], picture)
    assert np.any(pictures[1] != picture)
    assert one().render() is None


def test_an_own_reward_is_paid():
    made = one(observation="kinematics", reward=lambda transition: 7.0 + 0.0 * transition.configured)
    made.reset(seed=0)
    assert made.step(AHEAD)[1] == 7.0


@pytest.mark.parametrize("algorithm", ["DQN", "PPO"])
def test_stable_baselines3_trains_on_it(algorithm):
    library = require_extra("stable_baselines3")
    options = {"learning_starts": 32} if algorithm == "DQN" else {"n_steps": 64}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about what it runs on
        model = getattr(library, algorithm)("MultiInputPolicy", one(), batch_size=32, seed=0, device="cpu", **options)
        before = [x.detach().clone() for x in model.policy.parameters()]
        model.learn(128)
    assert any(not bool((x == y).all()) for x, y in zip(before, model.policy.parameters(), strict=True))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observation": "images"}, "observation must be one of image, code, kinematics, not 'images'"),
        ({"observation": "code"}, "observation 'code' needs a policy"),
        ({"worlds": 0}, "worlds must be at least 1"),
        ({"render_mode": "human"}, "render_mode must be 'rgb_array' or None, not 'human'"),
        ({"world": "paper", "worlds": 3}, "worlds must be 1 for 'paper'"),
    ],
)
def test_what_cannot_be_made_is_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        interop.DroneEnv(**{"world": "medium", **options})


def test_what_cannot_be_done_is_refused():
    made, vector = one(observation="kinematics"), many(2, observation="kinematics")
    for each in (made, vector):
        with pytest.raises(gymnasium.error.ResetNeeded, match="call reset first"):
            each.step(0 if each is made else np.zeros(2, int))
        with pytest.raises(ConfigError, match="mission must be whole numbers from 0 to 2, not 3"):
            each.reset(options={"mission": 3})
        with pytest.raises(ConfigError, match="may have 'mission' alone, not 'goal'"):
            each.reset(options={"goal": 3})
    for seeds in (-1, [0, -1], [0, None]):
        with pytest.raises(ConfigError, match="seeds must be whole numbers of at least 0"):
            vector.reset(seed=seeds)
    with pytest.raises(ConfigError, match="one seed, or 2, not 3"):
        vector.reset(seed=[1, 2, 3])
    with pytest.raises(ConfigError, match="num_envs must be at least 1"):
        many(0)
    with pytest.raises(ConfigError, match="autoreset_mode must be one of NextStep, SameStep, not 'Disabled'"):
        many(2, autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED)
    made.reset(seed=0)
    before = made.np_random.bit_generator.state
    with pytest.raises(ConfigError):
        made.reset(seed=5, options={"mission": 3})
    assert made.np_random.bit_generator.state == before  # a refused reset changes nothing
    vector.reset(seed=[0, 0])
    with pytest.raises(gymnasium.error.InvalidAction, match="from 0 to 26"):
        made.step(27)
    for moves in (np.array([0, 27]), np.array([0]), np.array([0.0, 1.0])):
        with pytest.raises(gymnasium.error.InvalidAction, match="2 actions, each a whole number from 0 to 26"):
            vector.step(moves)
    while not any(made.step(DOWN)[2:4]):
        pass
    with pytest.raises(gymnasium.error.ResetNeeded):
        made.step(DOWN)


def test_without_a_seed_episodes_differ_and_with_one_they_repeat():
    made = one(observation="kinematics")
    first = [made.reset(seed=3)[0], made.reset()[0], made.reset()[0]]
    again = [made.reset(seed=3)[0], made.reset()[0], made.reset()[0]]
    np.testing.assert_array_equal(first, again)
    starts = {tuple(np.asarray(made.reset()[0])[:2].round(3)) for _ in range(12)}
    assert len(starts) == 3  # each of the three worlds has one mission
    vector = many(8, observation="kinematics")
    vector.reset(seed=0)
    assert len(np.unique(vector.drones.key, axis=0)) == 8
