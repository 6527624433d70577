"""Runs: what is kept when one is stopped, what it ends with, when it validates."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import CameraConfig, Config, TrainConfig, WorldConfig
from edqn_jax.errors import ConfigError, StoppedError
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.learn import trainer
from edqn_jax.learn.plan import Plan
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.learn.state import Episodes
from edqn_jax.report.gallery import prepare_gallery
from edqn_jax.report.progress import Progress
from edqn_jax.runs.directory import RunDirectory
from edqn_jax.runs.policies import load_run
from edqn_jax.runs.record import train_run
from edqn_jax.runs.stopping import Stop
from edqn_jax.training.selection import Candidate, choose, first_success, is_due
from tests.miniature import WORLD as MINIATURE_WORLD
from tests.miniature import no_losses
from tests.whole.test_trainer import CONFIG as SMALL

CONFIG = dataclasses.replace(
    SMALL,
    camera=CameraConfig(width=8, height=6),
    env=dataclasses.replace(SMALL.env, max_decisions=12),
    world=WorldConfig(name=str(MINIATURE_WORLD), missions=32),
    train=TrainConfig(num_envs=16, chunk_steps=4, total_steps=512, validation_every=128, validation_missions=4),
)

FIGURES = {"world", "path", "returns", "learning"}
"""Names of the figures of every run."""


@pytest.mark.slow
def test_a_run_stopped_before_any_validation_keeps_what_it_has_learnt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def chunk(self, state, first: int):
        """Stands for the compiled chunk: the policy's parameters grow by one, nothing else happens."""
        agent = state.learner.agent
        agent = dataclasses.replace(agent, average=jax.tree.map(lambda x: x + 1, agent.average))
        learner = dataclasses.replace(state.learner, agent=agent)
        steps, none = CONFIG.train.chunk_steps, jnp.zeros((CONFIG.train.chunk_steps, 8, 2))
        return dataclasses.replace(state, learner=learner), (Episodes(none, none, none), no_losses(steps))

    monkeypatch.setattr(trainer.Trainer, "compile", lambda self: None)
    monkeypatch.setattr(trainer.Trainer, "chunk", chunk)
    config = dataclasses.replace(CONFIG, train=dataclasses.replace(CONFIG.train, validation_every=0))
    run = RunDirectory(tmp_path / "stopped")
    with pytest.raises(StoppedError, match="stopped after 256 decisions"):
        train_run(config, run, Progress(), Stop(lambda: len(run.read_metrics()) == 4), drawing=prepare_gallery)
    _, params = load_run(run.path)
    np.testing.assert_array_equal(params.q["Dense_0"]["bias"], 4.0)  # it began at zero and grew in four chunks
    assert not run.summary_file.exists()


def test_a_world_that_cannot_be_flown_leaves_nothing_behind(tmp_path: Path) -> None:
    file = tmp_path / "wall.xml"
    file.write_text(
        '<mujoco><worldbody><geom name="wall" type="box" pos="5 5 2" size="2 2 2"/>'
        '<site name="start" pos="5 5 2"/><site name="goal" pos="30 5 2"/></worldbody></mujoco>'
    )
    run = RunDirectory(tmp_path / "run")
    config = Config(world=WorldConfig(name=str(file)))
    with pytest.raises(ConfigError, match="the start .* lies inside 'wall'"):
        train_run(config, run, Progress(), Stop(), drawing=prepare_gallery)
    assert not run.path.exists()


@pytest.mark.parametrize(
    ("keep", "spls", "ends_with"),
    [
        ("best", [0.5, 0.9, 0.7], 200),
        ("best", [0.9, 0.5, 0.9], 300),  # the latest among equals
        ("best", [0.0], 100),  # what flies nowhere still comes before what was never flown
        ("last", [0.5, 0.9, 0.7], 300),
        ("best", [], 0),
        ("last", [], 0),
    ],
)
def test_a_run_ends_with_the_parameters_of_the_best_spl_or_the_last(
    keep: Literal["best", "last"], spls: list[float], ends_with: int
) -> None:
    params = PolicyParams(encoder={}, q={})
    kept = Candidate(params)
    for number, weighted in enumerate(spls, 1):
        # The success rate falls all the while: it must not count.
        kept = choose(keep, kept, Candidate(params, weighted, 1 / number, decisions=100 * number))
    assert kept.decisions == ends_with


def test_a_policy_flies_the_mission_from_its_first_good_validation() -> None:
    rates = [(100, 1.0, 0.5), (200, 2.0, 0.89), (300, 3.0, 0.9), (400, 4.0, 0.8)]
    assert first_success(rates) == (300, 3.0)
    assert first_success(rates[:2]) == (None, None)
    assert first_success([]) == (None, None)


@pytest.mark.parametrize(
    ("every", "checked", "done", "due"),
    [
        (100, 96, 6, False),  # 96 decisions of 16 environments
        (100, 96, 7, True),  # 112: a multiple is crossed, though not met
        (100, 112, 12, False),
        (100, 112, 13, True),
        (100, 0, 5, False),  # nothing is learnt before step 5
        (64, 0, 5, False),
        (64, 0, 6, True),
        (0, 96, 100, False),
    ],
)
def test_a_validation_is_due_where_a_multiple_is_crossed_once_there_was_learning(
    every: int, checked: int, done: int, due: bool
) -> None:
    config = Config(train=TrainConfig(num_envs=16, validation_every=every))
    assert is_due(config, Plan(total=200, scheduled=200, warmup=0, starts=5, vae_training=()), checked, done) is due


@pytest.mark.slow
def test_half_of_the_validation_begins_near_the_start_and_all_of_it_in_random_worlds() -> None:
    own, random = Config(), Config(world=WorldConfig(name="sparse", pool_size=2, missions=8))
    assert run_missions(own).near_start.sum() == own.train.validation_missions // 2
    assert run_missions(random).near_start.all()
