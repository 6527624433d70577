"""A user's reward: what it is given, and what a run says of it."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import edqn_jax
from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.judge import clearance, load_judge
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.interop import functional
from edqn_jax.runs.provenance import reward_record
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.scene.mjcf import scenes_folder
from edqn_jax.sim.task import env
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.task.reward import Reward, Transition
from edqn_jax.sim.worlds import geodesic
from edqn_jax.training.setup import config_for_reward, set_up_training
from tests.support.configs import BLIND_RUN

pytestmark = pytest.mark.whole

CONFIG = dataclasses.replace(Config(), env=dataclasses.replace(Config().env, sensor="blind"))

SOURCE = """
def bonus(transition):
    return transition.configured + {}


class Bonus:
    def __call__(self, transition):
        return transition.configured + {}
"""


@pytest.mark.parametrize("reward", [lambda: 0.0, lambda before, after: 0.0, "sparse"])
def test_what_cannot_be_a_reward_is_refused_where_it_is_given(reward: Any) -> None:
    for give in (
        lambda: edqn_jax.make("paper", reward=reward),
        lambda: edqn_jax.train(CONFIG, reward=reward),
        lambda: functional.make("paper", CONFIG, observation="kinematics", reward=reward),
    ):
        with pytest.raises(ConfigError, match=r"^a reward must be a function \(transition\), not "):
            give()


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        (None, "None"),
        ("high", "'high'"),
        (jnp.zeros(3), r"an array of shape \(3,\)"),
        ([1.0], "an object of"),
    ],
)
def test_a_reward_that_returns_no_number_is_told_so(returned: Any, told: str) -> None:
    environment = edqn_jax.make("paper", CONFIG, reward=lambda transition: returned)
    state, _ = environment.reset()
    with pytest.raises(ConfigError, match=rf"^a reward must return one number, a float32 \[\], not {told}"):
        environment.step(state, "up")


def test_what_a_reward_raises_itself_is_not_changed() -> None:
    def mine(transition: Transition) -> Any:
        raise KeyError("my own")

    environment = edqn_jax.make("paper", CONFIG, reward=mine)
    state, _ = environment.reset()
    with pytest.raises(KeyError, match="my own"):
        environment.step(state, "up")


@pytest.mark.slow
def test_a_reward_is_given_the_decision_that_was_flown_and_gives_what_is_paid() -> None:
    course = load_missions(CONFIG, "paper")
    world, radius = course.env_params, CONFIG.drone.body_radius_m
    judge = load_judge(mujoco.MjSpec.from_string(course.mjcf()[0]), radius)

    @jax.jit
    def decide(state: env.EnvState, action: jax.Array):
        given: list[Transition] = []

        def reward(transition: Transition) -> jax.Array:
            given.append(transition)
            return 2.5 * transition.before[2]

        after, step = env.step(CONFIG, dataclasses.replace(world, reward=reward), state, action)
        _, configured = env.step(CONFIG, world, state, action)
        return after, step, configured.reward, *given

    (down,) = np.flatnonzero((ACTIONS == (1, 1, -1)).all(axis=1))
    state, _ = jax.jit(lambda key: env.reset(CONFIG, world, key))(jax.random.key(0))
    outcomes = []
    while not state.ended:
        before = state.drone.position
        state, step, configured, transition = decide(state, jnp.int32(down))
        np.testing.assert_array_equal(transition.before, before)
        np.testing.assert_array_equal(transition.after, step.flight.position[-1])
        np.testing.assert_array_equal(transition.goal, world.missions.goal[0])
        assert transition.move == down and transition.outcome == step.outcome
        gap, _ = clearance(judge, np.asarray(transition.after))
        assert transition.clearance == pytest.approx(gap, abs=1e-4)  # float32 over 100 m
        # Two programs, and metres gained are differences of float32 distances of 130 m.
        assert transition.configured == pytest.approx(float(configured), abs=1e-4)
        assert step.reward == pytest.approx(2.5 * float(before[2]))
        outcomes.append(int(step.outcome))
    # Down to the ground, where the reward of an end differs from that of a step.
    assert outcomes[-1] == Outcome.COLLISION and set(outcomes[:-1]) == {Outcome.RUNNING}
    assert transition.clearance < 0.0 and transition.configured == pytest.approx(CONFIG.env.collision_reward, abs=5.0)


def load(file: Path, number: float, name: str, monkeypatch: pytest.MonkeyPatch) -> Reward:
    """What has this name in a file of a reward that adds `number`."""
    file.write_text(SOURCE.format(number, number), encoding="utf-8")
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, file.stem, module)  # where `inspect` looks for a class's file
    spec.loader.exec_module(module)
    found = getattr(module, name)
    return found() if isinstance(found, type) else found


@pytest.mark.parametrize("name", ["bonus", "Bonus"])
def test_a_run_names_its_reward_and_tells_one_source_from_another(name: str, tmp_path: Path, monkeypatch) -> None:
    first, again, other = (
        reward_record(Config(), load(tmp_path / f"{stem}.py", number, name, monkeypatch))
        for stem, number in (("reward_1", 1.0), ("reward_1_again", 1.0), ("reward_2", 2.0))
    )
    assert first == again and first["name"] == other["name"] == name
    assert first["source_sha256"] != other["source_sha256"]


def test_a_reward_without_a_source_has_no_digest() -> None:
    names: dict = {}
    exec("def bonus(transition): return transition.configured", names)
    assert reward_record(Config(), names["bonus"]) == {"name": "bonus", "source_sha256": None}


def test_the_configured_reward_has_its_own_name() -> None:
    shaped = dataclasses.replace(Config(), env=dataclasses.replace(Config().env, reward="potential"))
    assert reward_record(shaped, None) == {"name": "potential", "source_sha256": None}


def test_a_reward_of_ones_own_may_prefer_a_direction() -> None:
    turning = make_config("medium")
    assert turning.agent.turn and config_for_reward(turning, None) == turning
    straight = config_for_reward(turning, lambda transition: -transition.after[0])
    assert not straight.agent.turn
    assert dataclasses.replace(straight, agent=turning.agent) == turning


@pytest.mark.slow
def test_training_with_the_reward_geodesic_counts_metres_around_obstacles() -> None:
    world = str(scenes_folder() / "examples" / "corridor.xml")
    task = dataclasses.replace(BLIND_RUN.env, reward="geodesic")
    config = dataclasses.replace(BLIND_RUN, env=task, world=dataclasses.replace(BLIND_RUN.world, name=world))
    with set_up_training(config, agents=2) as preparation:
        distances = preparation.trainer.env_params.distances
        assert distances is not None and distances.remaining.ndim == 4  # one field for all agents
        scene = preparation.missions[0].scene
        way = geodesic.distance_to_goal(distances, jnp.int32(0), scene.goal, scene.start)
        assert float(way) > 1.15 * float(jnp.linalg.norm(scene.goal - scene.start))
        preparation.ready(begins=False)
