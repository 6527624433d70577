"""Several seeds in one program: a run of each, as if trained alone, and what they say together."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest

from edqn_jax.config import WorldConfig
from edqn_jax.errors import ConfigError, DivergedError, StoppedError
from edqn_jax.learn import trainer
from edqn_jax.report.gallery import prepare_gallery
from edqn_jax.runs.directory import RunDirectory, to_plain_json
from edqn_jax.runs.policies import load_policy
from edqn_jax.runs.record import train_run
from edqn_jax.runs.stopping import Stop
from edqn_jax.runs.verification.verify import verify_run
from edqn_jax.training import history
from edqn_jax.training.loop import train, train_seeds
from edqn_jax.training.progress import Progress
from tests.support.configs import BLIND_RUN, FIGURES
from tests.support.miniature import WORLD as MINIATURE_WORLD

RANDOM = dataclasses.replace(
    BLIND_RUN, world=WorldConfig(name="sparse", flown=str(MINIATURE_WORLD), pool_size=2, missions=8)
)


def read(run: RunDirectory) -> dict:
    return json.loads(run.summary_file.read_text())


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunDirectory, dict]:
    run = RunDirectory(tmp_path_factory.mktemp("runs") / "seeds")
    return run, train_run(RANDOM, run, Progress(), Stop(), drawing=prepare_gallery, seeds=2)


@pytest.mark.slow
def test_each_seed_leaves_a_run_and_all_of_them_a_summary(runs: tuple[RunDirectory, dict]) -> None:
    run, summary = runs
    assert read(run) == to_plain_json(summary)
    assert summary["seeds"] == [0, 1] and len(summary["success_rates"]) == 2
    assert summary["flown_successes"] == sum(load["success"] for load in map(read, (run.of_seed(0), run.of_seed(1))))
    # All but the world that is flown at the end are test worlds.
    assert summary["missions"] == BLIND_RUN.train.validation_missions - 1
    for seed in summary["seeds"]:
        own = run.of_seed(seed)
        assert load_policy(own.path).config.train.seed == seed
        found = read(own)
        assert (found["seed"], found["world"], found["flown"]) == (seed, "sparse", str(MINIATURE_WORLD))
        assert found["test"]["missions"] == summary["missions"]
        assert found["test"]["success_rate"] == summary["success_rates"][seed]
        assert found["shortest_path_m"] == pytest.approx(23.8, abs=0.5)  # of the miniature
        assert [row["phase"] for row in own.read_metrics()] == ["training"] * 4
        assert {file.stem for file in own.figures.glob("*.png")} == FIGURES  # this sensor shows nothing
    first, second = (run.of_seed(seed).read_episodes()["return"][:8] for seed in (0, 1))
    assert not np.array_equal(first, second)


@pytest.mark.slow
def test_the_runs_of_all_seeds_are_verified(runs: tuple[RunDirectory, dict]) -> None:
    findings = verify_run(runs[0].path)
    assert [finding for finding in findings if not finding.right] == []
    assert {"seed-1: the test worlds, flown again", "summary.json of all seeds"} < {each.what for each in findings}


@pytest.mark.slow
def test_a_seed_among_others_learns_what_it_learns_alone(runs: tuple[RunDirectory, dict]) -> None:
    alone = train(dataclasses.replace(RANDOM, train=dataclasses.replace(BLIND_RUN.train, seed=1)))
    together = load_policy(runs[0].of_seed(1).path)
    # Batched products round otherwise.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), alone.policy.params, together.params)
    (own,) = [ended.step for ended in alone.history.episodes[:1]]
    np.testing.assert_array_equal(own, runs[0].of_seed(1).read_episodes()["step"][: len(own)])


@pytest.mark.slow
def test_the_folder_of_several_seeds_is_no_policy(runs: tuple[RunDirectory, dict]) -> None:
    with pytest.raises(ConfigError, match="holds the runs of 2 seeds; name one of them, such as '.*seed-0'"):
        load_policy(runs[0].path)


@pytest.mark.slow
def test_stopping_stops_every_seed_and_keeps_their_policies(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "stopped")
    with pytest.raises(StoppedError, match="stopped after 64 decisions; the policies are in"):
        train_run(BLIND_RUN, run, Progress(), Stop(lambda: True), drawing=prepare_gallery, seeds=2)
    assert [load_policy(run.of_seed(seed).path).config.train.seed for seed in (0, 1)] == [0, 1]
    assert not run.summary_file.exists()


def test_no_agent_is_none_to_train() -> None:
    with pytest.raises(ConfigError, match="must be at least 1, not 0"):
        train_seeds(0, BLIND_RUN)


@pytest.mark.slow
def test_a_seed_that_diverges_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    chunk = trainer.Trainer.chunk

    def poisoned(self, state, first: int):
        state, (episodes, losses) = chunk(self, state, first)
        health = dataclasses.replace(losses.health, gradient=losses.health.gradient.at[1].set(999))
        return state, (episodes, dataclasses.replace(losses, health=health))

    monkeypatch.setattr(history, "MAX_DIVERGED_STEPS", 1)
    monkeypatch.setattr(trainer.Trainer, "chunk", poisoned)
    with pytest.raises(DivergedError, match="seed 1 diverged"):
        train_seeds(2, BLIND_RUN)
