"""Drones of one program as a vector of stable-baselines3: what it returns, and that its learners train through it."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import jax
import numpy as np
import pytest

import edqn_jax
from edqn_jax.config import DroneConfig
from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.interop.sb3_policy import sb3_policy
from edqn_jax.sim.task.outcomes import Outcome
from tests.support.interop.gym import DOWN, HOVER, MOVES, many, policy, small

library = require_extra("stable_baselines3")
interop = require_extra("edqn_jax.interop.stable_baselines3")


def drones(count: int = 3, **options: Any) -> Any:
    return interop.DroneVecEnv("EDQN/Random-v0", count, **{"config": small(), "worlds": 3, **options})


def short(decisions: int) -> edqn_jax.Config:
    """Episodes of so many decisions at most."""
    return edqn_jax.make_config(
        "medium", camera={"width": 16, "height": 12}, env={"max_decisions": decisions, "sensor": "blind"}
    )


def test_rows_are_those_of_the_pure_functions_without_the_resets():
    config = short(4)
    vector = drones(config=config, observation="kinematics")
    vector.seed(7)
    observed, pure = vector.reset(), edqn_jax.make("medium", config, worlds=3)
    states, seen = jax.vmap(lambda seed: pure.reset(jax.random.key(seed)))(7 + np.arange(3))
    step = jax.jit(jax.vmap(pure.step))
    ends = 0
    for moves in MOVES:
        np.testing.assert_allclose(observed, np.concatenate([seen.own, seen.motion], axis=1), rtol=1e-5, atol=1e-5)
        observed, rewards, dones, infos = vector.step(moves)
        states, done = step(states, moves)
        np.testing.assert_allclose(rewards, done.reward, rtol=1e-4, atol=1e-4)
        np.testing.assert_array_equal(dones, done.outcome != Outcome.RUNNING)
        ended = np.flatnonzero(dones)
        ends += len(ended)
        seen = done.observation
        for number in ended:
            last = np.concatenate([seen.own[number], seen.motion[number]])
            np.testing.assert_allclose(infos[number]["terminal_observation"], last, rtol=1e-5, atol=1e-5)
        if len(ended):  # the pure functions spend a step on the reset, of these drones alone
            after, reset = step(states, moves)
            chosen = lambda a, b: jax.vmap(jax.numpy.where)(dones, a, b)  # noqa: B023, E731
            assert np.all(reset.is_reset == dones)
            states, seen = (jax.tree.map(chosen, *pair) for pair in ((after, states), (reset.observation, seen)))
    assert ends >= 6


def test_what_ended_says_why_and_only_running_out_of_time_is_truncated():
    vector = drones(2, config=short(40), observation="kinematics")
    vector.reset()
    found: dict[str, dict[str, Any]] = {}
    while len(found) < 2:
        _, _, dones, infos = vector.step(np.array([DOWN, HOVER]))
        for info, done in zip(infos, dones, strict=True):
            assert ("terminal_observation" in info) == ("outcome" in info) == bool(done)
            assert done or info == {"TimeLimit.truncated": False}
            if done:
                found[info["outcome"]] = info
    assert set(found) == {"collision", "time_out"}
    assert [found[name]["TimeLimit.truncated"] for name in ("collision", "time_out")] == [False, True]
    assert not any(info["is_success"] for info in found.values())


def test_what_the_replay_holds_never_leads_from_an_end_to_a_start():
    vector = drones(3, config=short(5), observation="kinematics")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = library.DQN("MlpPolicy", vector, learning_starts=10**6, seed=0, device="cpu", buffer_size=300)
        model.learn(90)
    held = model.replay_buffer
    assert held.pos >= 30 and held.dones.sum() >= 15
    for row in range(held.pos - 1):
        for drone in range(3):
            next_row = held.observations[row + 1, drone]
            if held.dones[row, drone]:  # what follows is at rest, with no last move; what ended was not
                assert not next_row[-7:].any() and held.next_observations[row, drone][-7:].any()
            else:
                np.testing.assert_array_equal(held.next_observations[row, drone], next_row)
    assert held.timeouts.sum() >= 12 and np.all(held.dones >= held.timeouts)


@pytest.mark.parametrize("observation", ["image", "code"])
def test_it_flies_as_gymnasiums_vector_without_its_reset_rows(observation):
    options: dict[str, Any] = {"observation": observation, "worlds": 3}
    options |= {"policy": policy(), "config": None} if observation == "code" else {"config": small()}
    ours, theirs = drones(2, **options), many_of(options)
    ours.seed(3)
    mine, (other, _) = ours.reset(), theirs.reset(seed=3)
    moves, ends = np.array([DOWN, HOVER]), 0
    while ends < 2:
        for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-4)
        mine, _, dones, infos = ours.step(moves)
        other, _, terminated, truncated, _ = theirs.step(moves)
        np.testing.assert_array_equal(dones, terminated | truncated)
        if dones[0]:
            ends += 1
            last = jax.tree.leaves(jax.tree.map(lambda x: x[0], other))
            for a, b in zip(jax.tree.leaves(infos[0]["terminal_observation"]), last, strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-4)
            # The other drone flies on in both, so only the first is compared from here.
            moves = np.array([DOWN, HOVER])
            mine, other = (jax.tree.map(lambda x: x[:1], rows) for rows in (mine, theirs.step(moves)[0]))
            for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(other), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-4)
            break


def many_of(options: dict[str, Any]) -> Any:
    gymnasium = require_extra("gymnasium")
    return gymnasium.make_vec("EDQN/Random-v0", num_envs=2, **options)


def test_more_drones_end_at_once_than_one_call_resets():
    count = 2 * 16 + 3
    vector = drones(count, config=short(2), observation="kinematics", worlds=1)
    first = vector.reset()
    for _ in range(2):
        vector.step(np.full(count, HOVER))
        again, _, dones, infos = vector.step(np.full(count, HOVER))
        assert dones.all() and all(info["TimeLimit.truncated"] for info in infos)
        np.testing.assert_allclose(again, first, rtol=1e-5, atol=1e-5)  # the only mission once more


@pytest.mark.parametrize(("algorithm", "policy_name"), [("DQN", "MlpPolicy"), ("PPO", "MultiInputPolicy")])
def test_stable_baselines3_trains_through_it(algorithm, policy_name):
    observation = "kinematics" if policy_name == "MlpPolicy" else "image"
    vector = library.common.vec_env.VecMonitor(drones(4, observation=observation))
    options = {"learning_starts": 32} if algorithm == "DQN" else {"n_steps": 16}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about what it runs on
        model = getattr(library, algorithm)(policy_name, vector, batch_size=32, seed=0, device="cpu", **options)
        before = [x.detach().clone() for x in model.policy.parameters()]
        model.learn(256)
    assert any(not bool((x == y).all()) for x, y in zip(before, model.policy.parameters(), strict=True))
    assert len(model.ep_info_buffer) > 0 and len(model.ep_success_buffer) > 0
    rewards, lengths = library.common.evaluation.evaluate_policy(model, vector, 4, return_episode_rewards=True)
    assert len(rewards) == 4 and min(lengths) > 1


@pytest.mark.parametrize(("actions", "size"), [("velocity", 3), ("body-rates", 4)])
def test_sac_trains_with_continuous_actions(actions, size):
    config = edqn_jax.make_config(
        "medium", drone={"physics": "rigid_body"}, env={"actions": actions, "max_decisions": 20}
    )
    vector = drones(2, config=config, observation="kinematics")
    assert vector.action_space == require_extra("gymnasium").spaces.Box(-1.0, 1.0, (size,), np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about what it runs on
        model = library.SAC("MlpPolicy", vector, learning_starts=20, batch_size=16, seed=0, device="cpu")
        before = [x.detach().clone() for x in model.actor.parameters()]
        model.learn(60)
    assert any(not bool((x == y).all()) for x, y in zip(before, model.actor.parameters(), strict=True))
    held = model.replay_buffer
    assert held.dones.sum() >= 2 and held.actions.shape[-1] == size
    with pytest.raises(require_extra("gymnasium").error.InvalidAction, match=f"2 actions, each {size} finite numbers"):
        vector.step(np.full((2, size), np.nan))


def test_missions_seeds_and_attributes_are_those_of_the_vector():
    vector = drones(3, observation="kinematics", render_mode="rgb_array")
    vector.seed(5)
    vector.set_options([{"mission": number} for number in (2, 0, 1)])
    observed = vector.reset()
    starts = np.asarray(vector.envs.task.environment.world.missions.start)
    np.testing.assert_array_equal(vector.envs.drones.state.drone.position, starts[[2, 0, 1]])
    same = many(3, observation="kinematics")
    np.testing.assert_array_equal(observed, same.reset(seed=5, options={"mission": [2, 0, 1]})[0])
    vector.reset()  # seeds and options are used once
    assert np.any(np.asarray(vector.envs.drones.state.drone.position) != starts[[2, 0, 1]])
    assert vector.get_attr("render_mode") == ["rgb_array"] * 3 and vector.render().shape[2] == 3
    assert vector.env_is_wrapped(object) == [False] * 3
    vector.set_attr("note", 1)
    assert vector.get_attr("note", [0, 2]) == [1, 1]


def test_what_one_drone_cannot_do_is_refused():
    vector = drones(2, observation="kinematics")
    with pytest.raises(ConfigError, match="a drone has no method 'reset'"):
        vector.env_method("reset")
    with pytest.raises(ConfigError, match="'note' is set of all drones or of none"):
        vector.set_attr("note", 1, [0])
    vector.set_options({"goal": 1})
    with pytest.raises(ConfigError, match="may have 'mission' alone, not 'goal'"):
        vector.reset()


def test_a_trained_model_is_evaluated_as_a_policy():
    config = dataclasses.replace(short(8), drone=DroneConfig(physics="rigid_body"))
    vector = drones(2, config=config, observation="kinematics")
    model = library.PPO("MlpPolicy", vector, n_steps=8, batch_size=8, seed=0, device="cpu")
    model.learn(16)
    policy = sb3_policy(model, config, observation="kinematics")
    evaluation = edqn_jax.evaluate(policy, "medium", missions=2, record=True)
    environment, record = edqn_jax.make("medium", config, worlds=2, split="test"), evaluation.flights.record
    assert record is not None
    for mission, moves in enumerate(np.asarray(record.action)):
        state, seen = environment.reset(0, mission)
        for move in moves[moves >= 0]:
            vector = np.clip(np.concatenate([seen.own, seen.motion]), -10, 10)
            assert move == model.predict(vector, deterministic=True)[0]
            state, step = environment.step(state, int(move))
            seen = step.observation
