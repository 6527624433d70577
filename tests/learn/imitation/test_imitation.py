"""Imitation: the advice is what the teacher would do itself, a student learns it, what cannot teach is refused."""

from __future__ import annotations

import dataclasses
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import edqn_jax
from edqn_jax.cli.train import parse_train
from edqn_jax.config import LEARNERS, Config
from edqn_jax.config.loading import make_config
from edqn_jax.errors import ConfigError
from edqn_jax.learn.actor import AgentActor
from edqn_jax.learn.imitation.learner import choose_moves, imitation_of, init_state
from edqn_jax.learn.learner import Exploration, Teacher
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.learn.qnetwork import greedy_moves
from edqn_jax.learn.schedule import Schedule
from edqn_jax.learn.state import init_state as init_training
from edqn_jax.learn.step import run_steps, train_step
from edqn_jax.runs.policies import load_policy, save_policy
from edqn_jax.runs.teacher import load_teacher
from edqn_jax.sim.task.task import task_of
from edqn_jax.training.learner_check import check_learner
from tests.support.miniature import miniature_world
from tests.support.registries import keep_as_they_are

pytestmark = pytest.mark.whole

SMALL: dict[str, dict[str, Any]] = {
    "camera": {"width": 8, "height": 6},
    "drone": {"physics": "rigid_body"},
    "encoder": {"warmup_decisions": 64, "batch_size": 16, "replay_size": 512},
    "agent": {"batch_size": 16, "replay_size": 512, "learning_starts": 64},
    "train": {"num_envs": 16, "chunk_steps": 8, "total_steps": 16 * 64},
    "world": {"missions": 16},
}


def small(**groups: Any) -> Config:
    return make_config("paper", **{name: SMALL.get(name, {}) | groups.get(name, {}) for name in {*SMALL, *groups}})


DEPTH = small(env={"sensor": "depth"}, agent={"history": 3})


def decisive(config: Config) -> Policy:
    """A policy that has learnt nothing and whose moves depend on all that it sees, so that they are many."""
    params = fresh_policy(config, 3)
    return Policy(config, dataclasses.replace(params, q=jax.tree.map(lambda x: x - jnp.mean(x, 0), params.q)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("teacher") / "depth"
    save_policy(decisive(DEPTH), run)
    return run


def student(teacher: Path | str, **groups: Any) -> Config:
    groups["agent"] = {"learner": "imitation"} | groups.get("agent", {})
    groups["imitation"] = {"teacher": str(teacher)} | groups.get("imitation", {})
    return small(**groups)


@pytest.mark.slow
@pytest.mark.parametrize("mount", ["level", "body"])
def test_the_stored_advice_is_what_the_teacher_decides_where_it_flies_itself(mount: str, tmp_path: Path) -> None:
    camera = {"width": 8, "height": 6, "mount": mount}
    save_policy(decisive(small(env={"sensor": "depth"}, agent={"history": 3}, camera=camera)), tmp_path / "depth")
    half = {"teacher_moves": 0.5, "teacher_fraction": 1.0}
    steps, config = 40, student(tmp_path / "depth", imitation=half, camera=camera)
    world, plan, taught = miniature_world(config), Schedule.from_config(config), load_teacher(config)
    teacher, params = taught.config, taught.params
    state = jax.jit(lambda key: init_training(config, world, key))(jax.random.key(0))
    learn = jax.jit(partial(train_step, config, world, None))
    flat = partial(jax.tree.map, lambda x: x.reshape(-1, *x.shape[2:]))
    task, actor, moves = task_of(teacher), AgentActor(teacher), set()

    @jax.jit
    def fly(env, memory, action):
        _, seen = task.map(partial(task.step, world))(dataclasses.replace(env, memory=None), action)
        memory = jnp.where(seen.is_reset[:, None, None], actor.init(), memory)
        return actor.act(params, memory, seen.observation, jax.random.key(0))

    memory, advice = jnp.zeros((16, *actor.init().shape)), np.zeros(16)
    for step in range(steps):
        env = flat(state.actors.env)
        state, _ = learn(state, jnp.int32(step))
        ring = state.actors.replay
        at = int(plan.replay_time(jnp.int32(step))) % ring.advice.shape[1]
        np.testing.assert_array_equal(ring.advice[:, at].reshape(-1), advice)
        advice, memory = fly(env, memory, ring.action[:, at].reshape(-1))
        np.testing.assert_allclose(flat(state.actors.advice.memory), memory, atol=1e-4)
        moves |= {*np.asarray(advice).tolist()}
    assert len(moves) > 3


@pytest.mark.slow
def test_a_student_agrees_with_its_teacher_far_more_often_than_its_commonest_move_would(folder: Path) -> None:
    agent = {"updates_per_step": 8, "batch_size": 64, "replay_size": 4096, "history": 3}
    never = {"teacher_moves": 0.0}  # so that no move that was taken is the teacher's
    config = student(folder, env={"sensor": "blind"}, agent=agent, imitation=never, train={"total_steps": 16 * 256})
    world = miniature_world(config)
    before = jax.jit(lambda key: init_training(config, world, key))(jax.random.key(0))
    after, (_, losses) = jax.jit(lambda s: run_steps(config, world, s, jnp.arange(256)))(before)
    commonest = np.bincount(np.asarray(after.actors.replay.advice).ravel()).max() / 4096
    agreement = np.asarray(losses.metrics["agreement"])
    assert np.isnan(agreement[0]) and commonest < 0.5
    assert agreement[-8:].mean() > commonest + 0.3
    jax.tree.map(np.testing.assert_array_equal, after.learner.teacher, load_teacher(config).params)


def test_the_teacher_takes_the_share_of_moves_that_is_asked_for(folder: Path) -> None:
    config = student(folder, env={"sensor": "blind"}, imitation={"teacher_moves": 0.75, "teacher_fraction": 0.5})
    state = init_state(config, jax.random.key(0))
    memory = jax.random.normal(jax.random.key(1), (2, 500, config.agent.history, 10))
    own = greedy_moves(config.agent, state.q, memory)
    advice = (own + 1) % 27
    for decisions, share in ((0, 0.75), (25, 0.375), (50, 0.0), (90, 0.0)):
        progress = Exploration(jnp.int32(decisions), 100, jnp.zeros((2, 500), int), advice)
        moves, metrics = choose_moves(config, state, memory, jax.random.split(jax.random.key(2)), progress)
        taught = np.asarray(moves == advice)
        assert np.all(taught | (moves == own)) and metrics["teacher_moves"] == pytest.approx(share)
        assert taught.mean() == pytest.approx(share, abs=0.06)
        assert share == 0 or not np.array_equal(taught[0], taught[1])


def test_what_cannot_teach_is_refused_in_a_sentence(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^imitation.teacher must be the folder of a run with env.sensor depth, for"):
        student("")
    with pytest.raises(ConfigError, match=r"^encoder.levelled must be false with agent.learner imitation"):
        student(folder, camera={"mount": "body"}, encoder={"levelled": True})
    with pytest.raises(ConfigError, match="there is no run in '.*none': no such folder"):
        load_teacher(student(tmp_path / "none"))
    with pytest.raises(ConfigError, match=r"^imitation.teacher must be a policy of the sensor depth; .* of 'events'$"):
        load_teacher(student("pretrained"))
    other = student(folder, camera={"width": 16}, env={"speed_m_s": 2.0})
    says = "of '.*depth' camera.width is 8 and here 16; env.speed_m_s is .* and here 2.0$"
    with pytest.raises(ConfigError, match=f"^imitation.teacher must see and command as its student does; {says}"):
        edqn_jax.train(other)


def test_a_student_flies_without_its_teacher(tmp_path: Path) -> None:
    save_policy(decisive(DEPTH), tmp_path / "depth")
    config = student(tmp_path / "depth")
    save_policy(Policy(config, fresh_policy(config)), tmp_path / "student")
    shutil.rmtree(tmp_path / "depth")
    assert load_policy(tmp_path / "student").config == config


def test_a_teacher_that_is_trained_on_is_loaded_anew(tmp_path: Path) -> None:
    save_policy(decisive(DEPTH), tmp_path / "depth")
    config = student(tmp_path / "depth")
    before = load_teacher(config)
    assert load_teacher(config) is before
    shutil.rmtree(tmp_path / "depth")
    save_policy(Policy(DEPTH, fresh_policy(DEPTH, 9)), tmp_path / "depth")
    assert load_teacher(config) is not before


def test_the_command_holds_the_whole_path_of_the_teacher(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder.parent)
    _, config = parse_train(["--learner", "imitation", "--imitation.teacher", folder.name, "--tuned-for", "cpu"])
    assert config.imitation.teacher == str(folder.resolve())


def test_a_learner_of_ones_own_may_have_a_teacher_and_others_have_none(monkeypatch: pytest.MonkeyPatch) -> None:
    keep_as_they_are(monkeypatch)
    LEARNERS.register("taught", imitation_of(lambda config: Teacher(DEPTH, decisive(DEPTH).params)))
    for learner, taught in (("taught", True), ("dqn", False), ("pqn", False)):
        config = small(agent={"learner": learner})
        check_learner(config)
        shapes = jax.eval_shape(partial(init_training, config, miniature_world(config)), jax.random.key(0))
        names = {jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(shapes)}
        assert any("advice" in name or "teacher" in name for name in names) == taught
