"""The functional environment is the same task, with no transition across a reset."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

import edqn_jax
from edqn_jax.config import AirConfig, BodyConfig, Config, NoiseConfig
from edqn_jax.config.loading import make_config
from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.interop import functional
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.sim.actions import move_number
from edqn_jax.sim.task.outcomes import Outcome

interop = require_extra("edqn_jax.interop.gymnasium")

DOWN, HOVER = int(move_number("down")), int(move_number("hover"))
MOVES = np.random.default_rng(5).integers(0, 27, size=(40, 3))
MOVES[:, 0] = DOWN  # the first drone soon ends, and begins anew

FARTHEST_M = 4.0 * 3**0.5 * 0.26 * 1.5
"""That a drone flies in a decision at the commanded speed along all three axes, and half as much again."""


@functools.cache
def small(world: str = "medium", max_decisions: int = 200) -> Config:
    """Few pixels, and physics that compile in less time."""
    config = make_config(world, env={"max_decisions": max_decisions}, drone={"physics": "rigid_body"})
    return dataclasses.replace(config, camera=dataclasses.replace(config.camera, width=16, height=12))


def made(kind: functional.Kind, **options: Any) -> tuple[functional.FunctionalEnv, functional.Params]:
    if kind == "code":
        return functional.make("medium", observation=kind, policy=Policy(small(), fresh_policy(small())), worlds=3)
    return functional.make("medium", **{"config": small(), "observation": kind, "worlds": 3, **options})


def jitted(env: functional.FunctionalEnv) -> tuple[Any, Any]:
    return jax.jit(env.reset), jax.jit(env.step)


def place(env: functional.FunctionalEnv, params: functional.Params, state: functional.State, observed: Array) -> Array:
    """Returns the position [3] in metres that an observation tells of."""
    volume = params.world.pool.volume[params.world.missions.scene[state.flight.mission]]
    return volume[0] + (observed[4:7] + 1) / 2 * (volume[1] - volume[0])


def test_a_flight_is_that_of_the_pure_functions() -> None:
    env, params = made("image")
    pure = edqn_jax.make("medium", small(), worlds=3)
    reset, step = jitted(env)
    observed, state = reset(jax.random.key(3), params, jnp.int32(1))
    expected, seen = pure.reset(3, 1)
    resets = 0
    for move in MOVES[:, 0]:
        np.testing.assert_array_equal(observed["own"], seen.own)
        np.testing.assert_array_equal(observed["motion"], np.clip(seen.motion, -10, 10))
        counts = np.sign(observed["image"]) * np.expm1(np.abs(observed["image"]))
        # exp and log of whole numbers up to a few dozen, in float32
        np.testing.assert_allclose(counts, pure.event_image(seen), rtol=1e-5, atol=1e-5)
        observed, state, reward, terminated, truncated, info = step(state.flight.key, state, jnp.int32(move), params)
        expected, taken = pure.step(expected, int(move))
        seen = taken.observation
        assert float(reward) == float(taken.reward) and int(info["outcome"]) == int(taken.outcome)
        assert bool(info["is_reset"]) == bool(taken.is_reset)
        assert bool(terminated | truncated) == bool(expected.ended)
        resets += int(taken.is_reset)
    assert resets >= 1


def test_a_disturbed_flight_is_that_of_the_pure_functions_and_every_episode_draws_anew() -> None:
    config = dataclasses.replace(
        small(),
        env=dataclasses.replace(small().env, action_delay=1),
        air=AirConfig(gusts_m_s=5.0),
        body=BodyConfig(mass_share=0.2),
        noise=NoiseConfig(position_m=0.5),
    )
    env, params = made("kinematics", config=config)
    pure = edqn_jax.make("medium", config, worlds=3)
    reset, step = jitted(env)
    (observed, state), (expected, seen) = reset(jax.random.key(3), params, jnp.int32(1)), pure.reset(3, 1)
    masses = set()
    for move in MOVES[:, 0]:
        # two programs that XLA fuses in its own ways
        np.testing.assert_allclose(observed, jnp.concatenate([seen.own, seen.motion]), rtol=1e-4, atol=1e-4)
        masses.add(float(state.flight.disturbance.mass))
        observed, state, *_ = step(state.flight.key, state, jnp.int32(move), params)
        expected, taken = pure.step(expected, int(move))
        seen = taken.observation
    assert len(masses) > 1 and all(0.8 <= mass <= 1.2 for mass in masses)


@pytest.mark.parametrize("kind", ["image", "code", "kinematics"])
def test_many_drones_are_gymnasiums_vector(kind: functional.Kind) -> None:
    env, params = made(kind)
    options = {"policy": Policy(small(), fresh_policy(small()))} if kind == "code" else {"config": small()}
    vector = interop.DroneVectorEnv(3, "medium", observation=kind, worlds=3, **options)
    seen, _ = vector.reset(seed=0)
    reset = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))
    step = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))
    observed, states = reset(jax.vmap(jax.random.key)(jnp.arange(3)), params)
    for moves in MOVES[:20]:
        # two programs that XLA fuses in its own ways
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-4), observed, seen)
        observed, states, rewards, terminated, truncated, _ = step(states.flight.key, states, moves, params)
        seen, *expected, _ = vector.step(moves)
        np.testing.assert_allclose(rewards, expected[0], rtol=1e-3, atol=1e-3)
        np.testing.assert_array_equal(terminated, expected[1])
        np.testing.assert_array_equal(truncated, expected[2])


def test_a_scan_over_many_drones_is_a_loop_over_one() -> None:
    env, params = made("kinematics")

    def rollout(key: Array, moves: Array) -> tuple[Array, Array]:
        observed, state = env.reset(key, params, jnp.int32(2))

        def decide(carry: tuple, move: Array) -> tuple[tuple, tuple[Array, Array]]:
            key, state = carry
            key, used = jax.random.split(key)
            observed, state, reward, *_ = env.step(used, state, move, params)
            return (key, state), (observed, reward)

        return jax.lax.scan(decide, (key, state), moves)[1]

    keys, moves = jax.random.split(jax.random.key(0), 3), jnp.asarray(MOVES.T)
    together = jax.jit(jax.vmap(rollout))(keys, moves)
    reset, step = jitted(env)
    _, state = reset(keys[0], params, jnp.int32(2))
    key = keys[0]
    for number, move in enumerate(moves[0]):
        key, used = jax.random.split(key)
        observed, state, reward, *_ = step(used, state, move, params)
        np.testing.assert_allclose(together[0][0, number], observed, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(together[1][0, number], reward, rtol=1e-3, atol=1e-3)


def test_time_out_truncates_and_a_collision_terminates() -> None:
    env, params = made("kinematics", config=small(max_decisions=2))
    reset, step = jitted(env)
    _, state = reset(jax.random.key(0), params)
    for ends in (False, True):
        _, state, _, terminated, truncated, info = step(state.flight.key, state, HOVER, params)
        assert (bool(terminated), bool(truncated)) == (False, ends)
    assert int(info["outcome"]) == Outcome.TIME_OUT and int(info["episode_length"]) == 2
    env, params = made("kinematics")
    reset, step = jitted(env)
    _, state = reset(jax.random.key(0), params)
    while not state.flight.ended:
        _, state, _, terminated, truncated, info = step(state.flight.key, state, DOWN, params)
    assert bool(terminated) and not bool(truncated) and not bool(info["is_success"])


@pytest.mark.parametrize("autoreset", [False, True])
def test_no_transition_leads_from_one_episode_into_another(autoreset: bool) -> None:
    env, params = made("kinematics")
    function = env.step_autoreset if autoreset else env.step
    reset, step = jax.jit(env.reset), jax.jit(function)
    observed, state = reset(jax.random.key(1), params)
    ends = jumps = 0
    for number in range(60):
        before = place(env, params, state, observed)
        came_from = state
        observed, state, reward, terminated, truncated, info = step(jax.random.key(number), state, DOWN, params)
        # The true next observation: with autoreset it stands in the info, else a reset is marked as no transition.
        after = place(env, params, came_from, info["final_observation"] if autoreset else observed)
        if info["is_reset"]:
            jumps += 1
            assert not autoreset and float(reward) == 0.0 and not terminated and not truncated
        else:
            assert np.linalg.norm(after - before) < FARTHEST_M
        ends += int(terminated | truncated)
    assert ends >= 2 and (autoreset or jumps >= 2)


def test_autoreset_returns_the_first_observation_and_keeps_the_final_one() -> None:
    env, params = made("image")
    reset, step, autoreset = jax.jit(env.reset), jax.jit(env.step), jax.jit(env.step_autoreset)
    _, state = reset(jax.random.key(0), params)
    ended = False
    while not ended:
        key = jax.random.key(7)
        own, fresh = jax.random.split(key)
        expected = step(own, state, DOWN, params)
        observed, after, reward, terminated, truncated, info = autoreset(key, state, DOWN, params)
        ended = bool(terminated | truncated)
        # two programs that XLA fuses in its own ways
        close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
        jax.tree.map(close, info["final_observation"], expected[0])
        close(reward, expected[2])
        first = reset(fresh, params)[0] if ended else expected[0]
        jax.tree.map(close, observed, first)
        state = after
    assert not state.flight.ended and int(state.flight.decision) == 0
    assert not np.allclose(observed["own"], info["final_observation"]["own"])
    assert int(info["episode_length"]) > 1


@pytest.mark.parametrize("kind", ["image", "code", "kinematics"])
def test_the_spaces_are_those_of_what_is_returned(kind: functional.Kind) -> None:
    env, params = made(kind)
    observed = jax.eval_shape(env.reset, jax.random.key(0), params)[0]
    space = env.observation_space(params)
    shapes = {name: box.shape for name, box in space.items()} if isinstance(space, dict) else space.shape
    assert jax.tree.map(lambda x: x.shape, observed) == shapes
    assert {x.dtype for x in jax.tree.leaves(observed)} == {jnp.dtype("float32")}
    assert env.action_space(params) == functional.Discrete(env.num_actions) == functional.Discrete(27)


@pytest.mark.parametrize(
    ("actions", "action", "says"),
    [
        ("moves", 27, "an action of 'moves' is a whole number from 0 to 26, not 27"),
        ("moves", -1, "an action of 'moves' is a whole number from 0 to 26, not -1"),
        ("moves", 1.5, "an action of 'moves' is a whole number from 0 to 26, not 1.5"),
        ("velocity", (0.0, np.nan, 0.0), "an action of 'velocity' is 3 finite numbers from -1 to 1, not"),
        ("body-rates", (0.0, 0.0, 0.0), "an action of 'body-rates' is 4 finite numbers from -1 to 1, not"),
    ],
)
def test_an_action_that_there_is_not_is_refused_outside_of_jit(actions: str, action: Any, says: str) -> None:
    config = dataclasses.replace(small(), env=dataclasses.replace(small().env, actions=actions))
    env, params = made("kinematics", config=config)
    _, state = jax.eval_shape(env.reset, jax.random.key(0), params)
    for step in (env.step, env.step_autoreset):
        with pytest.raises(ConfigError, match=says):
            step(jax.random.key(0), state, jnp.asarray(action), params)


def test_other_worlds_of_the_same_number_need_no_new_compilation() -> None:
    env, params = made("kinematics")
    _, others = made("kinematics", world_seed=1)
    traces = []

    @jax.jit
    def start(params: functional.Params) -> Array:
        traces.append(None)
        return env.reset(jax.random.key(0), params, jnp.int32(0))[1].flight.drone.position

    assert not np.allclose(start(params), start(others)) and len(traces) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observation": "images"}, "observation must be one of image, code, kinematics, not 'images'"),
        ({"observation": "code"}, "observation 'code' needs a policy"),
        ({"worlds": 0}, "worlds must be at least 1"),
        ({"world": "paper", "worlds": 3}, "worlds must be 1 for 'paper'"),
    ],
)
def test_what_cannot_be_made_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        functional.make(**{"world": "medium", **options})
