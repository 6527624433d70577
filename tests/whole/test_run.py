"""Runs: what is kept when one is stopped, what it ends with, when it validates."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import Config, WorldConfig
from edqn_jax.errors import ConfigError, StoppedError
from edqn_jax.learn import trainer
from edqn_jax.learn.state import Episodes
from edqn_jax.report.gallery import prepare_gallery
from edqn_jax.runs.directory import RunDirectory
from edqn_jax.runs.policies import load_run
from edqn_jax.runs.record import train_run
from edqn_jax.runs.stopping import Stop
from edqn_jax.training.progress import Progress
from tests.support.configs import TINY_RUN
from tests.support.miniature import no_losses


@pytest.mark.slow
def test_a_run_stopped_before_any_validation_keeps_what_it_has_learnt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def chunk(self, state, first: int):
        """Stands for the compiled chunk: the policy's parameters grow by one, nothing else happens."""
        agent = state.learner.agent
        agent = dataclasses.replace(agent, average=jax.tree.map(lambda x: x + 1, agent.average))
        learner = dataclasses.replace(state.learner, agent=agent)
        steps, none = TINY_RUN.train.chunk_steps, jnp.zeros((TINY_RUN.train.chunk_steps, 8, 2))
        return dataclasses.replace(state, learner=learner), (Episodes(none, none, none), no_losses(steps))

    monkeypatch.setattr(trainer.Trainer, "compile", lambda self: None)
    monkeypatch.setattr(trainer.Trainer, "chunk", chunk)
    config = dataclasses.replace(TINY_RUN, train=dataclasses.replace(TINY_RUN.train, validation_every=0))
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
