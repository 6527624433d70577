"""The training command, whole and small: what a run leaves behind, and what it keeps when it is stopped."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.cli.arguments import EvaluateArgs
from edqn_jax.cli.evaluate import evaluate_command
from edqn_jax.config import CameraConfig, Config, TrainConfig, WorldConfig
from edqn_jax.errors import ConfigError, StoppedError
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.learn import trainer
from edqn_jax.learn.plan import Plan
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.learn.trainer import Episodes
from edqn_jax.report.progress import Progress
from edqn_jax.runs.checkpoints import save_params
from edqn_jax.runs.directory import TRAJECTORY_COLUMNS, RunDirectory, plain
from edqn_jax.runs.policies import load_run
from edqn_jax.training.run import train_run
from edqn_jax.training.selection import Candidate, choose, first_success, is_due
from edqn_jax.training.stopping import Stop
from edqn_jax.training.verify import verify
from tests.learn.test_trainer import CONFIG as SMALL
from tests.miniature import WORLD as MINIATURE_WORLD
from tests.miniature import no_losses
from tests.processes import ROOT

CONFIG = dataclasses.replace(
    SMALL,
    camera=CameraConfig(width=8, height=6),
    env=dataclasses.replace(SMALL.env, max_decisions=12),
    world=WorldConfig(name=str(MINIATURE_WORLD), missions=32),
    train=TrainConfig(num_envs=16, chunk_steps=4, total_steps=512, validation_every=128, validation_missions=4),
)


KILLED = """
import sys, time
from pathlib import Path
from tests import conftest
from tests.training.test_run import CONFIG, Progress, RunDirectory, Stop, train_run
from edqn_jax.training import keeper
import dataclasses
keeper.MOST_OVERHEAD = 1e9
often = dataclasses.replace(CONFIG, train=dataclasses.replace(CONFIG.train, checkpoint_every_s=1e-3))
train_run(often, RunDirectory(Path(sys.argv[1])), Progress(), Stop(lambda: time.sleep(0.2)))
"""
"""A run with a checkpoint after every chunk, which takes long enough to be killed."""

FIGURES = {"world", "path", "returns", "learning"}
"""Names of the figures of every run."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunDirectory, dict]:
    run = RunDirectory(tmp_path_factory.mktemp("runs") / "whole")
    return run, train_run(CONFIG, run, Progress(), Stop())


@pytest.mark.slow
def test_a_run_leaves_what_the_readme_promises(whole: tuple[RunDirectory, dict]) -> None:
    run, summary = whole
    assert json.loads(run.summary_file.read_text()) == plain(summary)
    assert summary["reward"] == {"name": CONFIG.env.reward, "source_sha256": None}
    figures = {file.stem for file in run.figures.glob("*.png")}
    assert figures == FIGURES | {"events", "reconstruction"}
    assert summary["train_decisions"] == 512 and summary["outcome"] in {"time_out", "collision", "left_volume"}
    assert summary["success"] is False and summary["shortest_path_m"] == pytest.approx(23.8, abs=0.5)
    table = np.loadtxt(run.trajectory_file, delimiter=",", skiprows=1)
    assert table.shape[1] == len(TRAJECTORY_COLUMNS)
    assert table[-1, 0] == pytest.approx(summary["flight_seconds"], abs=0.02)
    validations = [row for row in run.read_metrics() if "validation_spl" in row]
    assert [row["decisions"] for row in validations] == [192, 256, 384, 512]  # the first when learning had begun
    best = max(row["validation_spl"] for row in validations)
    chosen = [row["decisions"] for row in validations if row["validation_spl"] == best][-1]
    assert (summary["parameters_from_decisions"], summary["validation_spl"]) == (chosen, best)
    config, _ = load_run(run.path)
    assert config == CONFIG


@pytest.mark.slow
def test_a_run_is_evaluated_and_says_what_was_flown(whole: tuple[RunDirectory, dict], tmp_path: Path) -> None:
    run, summary = whole
    # As many missions as in a validation, and recorded: the program that has flown those flies these.
    figures, flights = tmp_path / "figures.json", tmp_path / "flights.npz"
    missions = CONFIG.train.validation_missions
    evaluate_command(EvaluateArgs(run.path, missions=missions, json=figures, trajectories=flights))
    found = json.loads(figures.read_text())
    assert found["missions"] == missions and len(np.load(flights)["outcome"]) == missions
    assert (found["run"], found["versions"]) == (str(run.path), summary["versions"])
    sealed = run.checkpoints / "policy" / "manifest.json"
    assert found["policy_sha256"] == hashlib.sha256(sealed.read_bytes()).hexdigest()


@pytest.mark.slow
def test_a_run_is_verified_and_what_was_changed_in_it_is_found(
    whole: tuple[RunDirectory, dict], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    findings = verify(whole[0].path)
    assert [finding for finding in findings if not finding.right] == []
    changed = RunDirectory(tmp_path / "changed")
    shutil.copytree(whole[0].path, changed.path)
    # The flights do not change: they need not be flown a third time.
    flown = fly_on_all_devices(CONFIG, run_missions(CONFIG).final.world, load_run(changed.path)[1], 0, record=True)
    monkeypatch.setattr("edqn_jax.training.verify.fly_on_all_devices", lambda *_, **__: flown)

    def wrong() -> set[str]:
        return {finding.what for finding in verify(changed.path) if finding.right is False}

    assert wrong() == set()
    rewrite(changed.summary_file, '"path_length_m": ', '"path_length_m": 1')
    assert wrong() == {"summary.json from trajectory.csv"}
    rewrite(changed.metrics_file, '"validation_spl": ', '"validation_spl": 1')
    rewrite(changed.episodes_file, "collision", "goal")
    raw = {"summary.json from metrics.jsonl", "episodes.csv and metrics.jsonl", "metrics.jsonl and episodes.csv"}
    assert wrong() == {"summary.json from trajectory.csv", *raw}
    # What is changed everywhere alike is not what the last checkpoint has.
    first = json.loads(changed.summary_file.read_text())
    changed.write_summary({**first, "success_rate": 1.0, "reward": {"name": "mine", "source_sha256": None}})
    assert {"summary.json", "summary.json from the last checkpoint"} <= wrong()
    changed.write_summary(first)
    *lines, last = changed.trajectory_file.read_text().splitlines()
    t, _, *others = last.split(",")
    changed.trajectory_file.write_text("\n".join([*lines, ",".join([t, "9.5", *others])]) + "\n")
    params = load_run(changed.path)[1]
    other = dataclasses.replace(params, q=jax.tree.map(lambda leaf: leaf + 1.0, params.q))
    save_params(changed.checkpoints, other, changed.config_file)
    rewrite(changed.summary_file, '"state_digest": "', '"state_digest": "0')
    assert {"the flight, flown again", "last checkpoint", "policy"} <= wrong()
    for checkpoint in changed.checkpoints.glob("step-*"):
        shutil.rmtree(checkpoint)
    assert "last checkpoint" not in wrong()  # there is nothing left to compare
    summary = json.loads(changed.summary_file.read_text())
    for damaged in ({**summary, "devices": 3}, {"figures": "drawn"}):
        changed.write_summary(damaged)
        with pytest.raises(ConfigError, match="a file of the run in .* is not as a run writes it"):
            verify(changed.path)
    changed.write_summary(summary)
    rewrite(changed.summary_file, '"figures": "drawn"', '"figures": "to be drawn"')
    with pytest.raises(ConfigError, match="is not finished; continue it with edqn train"):
        verify(changed.path)


def rewrite(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


@pytest.mark.slow
def test_a_run_stopped_before_any_validation_keeps_what_it_has_learnt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def chunk(self, state, first: int):
        """Stands for the compiled chunk: the policy's parameters grow by one, nothing else happens."""
        learner = dataclasses.replace(state.learner, average=jax.tree.map(lambda x: x + 1, state.learner.average))
        steps, none = CONFIG.train.chunk_steps, jnp.zeros((CONFIG.train.chunk_steps, 8, 2))
        return dataclasses.replace(state, learner=learner), (Episodes(none, none, none), no_losses(steps))

    monkeypatch.setattr(trainer.Trainer, "compile", lambda self: None)
    monkeypatch.setattr(trainer.Trainer, "chunk", chunk)
    config = dataclasses.replace(CONFIG, train=dataclasses.replace(CONFIG.train, validation_every=0))
    run = RunDirectory(tmp_path / "stopped")
    with pytest.raises(StoppedError, match="stopped after 256 decisions"):
        train_run(config, run, Progress(), Stop(lambda: len(run.read_metrics()) == 4))
    _, params = load_run(run.path)
    np.testing.assert_array_equal(params.q["Dense_0"]["bias"], 4.0)  # it began at zero and grew in four chunks
    assert not run.summary_file.exists()


@pytest.mark.slow
def test_an_interrupted_run_that_is_continued_is_the_run_that_was_not(
    whole: tuple[RunDirectory, dict], tmp_path: Path
) -> None:
    uninterrupted, expected = whole
    run = RunDirectory(tmp_path / "cut")
    words = [sys.executable, "-c", KILLED, str(run.path)]
    with subprocess.Popen(words, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None and len(list(run.checkpoints.glob("step-*[0-9]"))) < 2:
            time.sleep(0.01)
        time.sleep(random.Random(0).uniform(0.0, 0.3))  # in a chunk, while it saves, or between
        assert process.poll() is None, process.communicate()[1]
        process.kill()
    # As if it had been killed while it wrote.
    with run.metrics_file.open("a") as file:
        file.write('{"decisions": 25')
    summary = train_run(CONFIG, dataclasses.replace(run, resume="must"), Progress(), Stop())
    assert 0 < summary["resumed_at_decisions"][0] < 512
    clocks = [name for name in summary if "seconds" in name or name == "resumed_at_decisions"]
    for name in [*clocks, "decisions_per_second"]:
        assert name == "flight_seconds" or (summary.pop(name), expected.get(name)) is not None
    assert summary == {name: expected[name] for name in summary}  # the state's digest among them
    assert run.episodes_file.read_bytes() == uninterrupted.episodes_file.read_bytes()
    assert _without_clocks(run) == _without_clocks(uninterrupted)
    ended = [load_run(folder.path)[1] for folder in (run, uninterrupted)]
    jax.tree.map(np.testing.assert_array_equal, *ended)
    *_, policy, before, last = sorted(place.name for place in run.checkpoints.iterdir())
    assert (policy, last) == ("policy", "step-000000032") and before.startswith("step-")


def _without_clocks(run: RunDirectory) -> list[dict]:
    return [{name: value for name, value in row.items() if "second" not in name} for row in run.read_metrics()]


def test_a_world_that_cannot_be_flown_leaves_nothing_behind(tmp_path: Path) -> None:
    file = tmp_path / "wall.xml"
    file.write_text(
        '<mujoco><worldbody><geom name="wall" type="box" pos="5 5 2" size="2 2 2"/>'
        '<site name="start" pos="5 5 2"/><site name="goal" pos="30 5 2"/></worldbody></mujoco>'
    )
    run = RunDirectory(tmp_path / "run")
    config = Config(world=WorldConfig(name=str(file)))
    with pytest.raises(ConfigError, match="the start .* lies inside 'wall'"):
        train_run(config, run, Progress(), Stop())
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
