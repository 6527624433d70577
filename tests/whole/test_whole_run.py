"""A whole run: what it leaves, what is evaluated and verified of it, and one that was killed."""

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

import jax
import numpy as np
import pytest

from edqn_jax.cli.evaluate import EvaluateArgs, evaluate_command
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.evaluation.trajectories import TRAJECTORY_COLUMNS
from edqn_jax.report.gallery import prepare_gallery
from edqn_jax.runs.checkpoints.params import POLICY, save_params
from edqn_jax.runs.directory import RunDirectory, to_plain_json
from edqn_jax.runs.policies import load_run
from edqn_jax.runs.record import train_run
from edqn_jax.runs.stopping import Stop
from edqn_jax.runs.verification.verify import verify_run
from edqn_jax.training.progress import Progress
from tests.support.configs import FIGURES, TINY_RUN
from tests.support.processes import ROOT

KILLED = """
import sys, time
from pathlib import Path
from tests import conftest
from edqn_jax.report.gallery import prepare_gallery
from edqn_jax.training.progress import Progress
from edqn_jax.runs import checkpointer
from edqn_jax.runs.directory import RunDirectory
from edqn_jax.runs.record import train_run
from edqn_jax.runs.stopping import Stop
from tests.support.configs import TINY_RUN
import dataclasses
checkpointer.MAX_OVERHEAD = 1e9
often = dataclasses.replace(TINY_RUN, train=dataclasses.replace(TINY_RUN.train, checkpoint_every_s=1e-3))
train_run(often, RunDirectory(Path(sys.argv[1])), Progress(), Stop(lambda: time.sleep(0.2)), drawing=prepare_gallery)
"""
"""A run with a checkpoint after every chunk, which takes long enough to be killed."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunDirectory, dict]:
    run = RunDirectory(tmp_path_factory.mktemp("runs") / "whole")
    return run, train_run(TINY_RUN, run, Progress(), Stop(), drawing=prepare_gallery)


@pytest.mark.slow
def test_a_run_leaves_what_the_readme_promises(whole: tuple[RunDirectory, dict]) -> None:
    run, summary = whole
    assert json.loads(run.summary_file.read_text()) == to_plain_json(summary)
    assert summary["reward"] == {"name": TINY_RUN.env.reward, "source_sha256": None}
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
    assert config == TINY_RUN


@pytest.mark.slow
def test_a_run_is_evaluated_and_says_what_was_flown(whole: tuple[RunDirectory, dict], tmp_path: Path) -> None:
    run, summary = whole
    # As many missions as in a validation, and recorded: the program that has flown those flies these.
    figures, flights = tmp_path / "figures.json", tmp_path / "flights.npz"
    missions = TINY_RUN.train.validation_missions
    evaluate_command(EvaluateArgs(run.path, missions=missions, json=figures, trajectories=flights))
    found = json.loads(figures.read_text())
    assert found["missions"] == missions and len(np.load(flights)["outcome"]) == missions
    assert (found["run"], found["versions"]) == (str(run.path), summary["versions"])
    sealed = run.checkpoints / POLICY
    assert found["policy_sha256"] == hashlib.sha256(sealed.read_bytes()).hexdigest()


@pytest.mark.slow
def test_a_run_is_verified_and_what_was_changed_in_it_is_found(
    whole: tuple[RunDirectory, dict], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    findings = verify_run(whole[0].path)
    assert [finding for finding in findings if not finding.right] == []
    changed = RunDirectory(tmp_path / "changed")
    shutil.copytree(whole[0].path, changed.path)
    # The flights do not change: they need not be flown a third time.
    flown = fly_on_all_devices(
        TINY_RUN, run_missions(TINY_RUN).final.env_params, load_run(changed.path)[1], 0, record=True
    )
    monkeypatch.setattr("edqn_jax.runs.verification.verify.fly_on_all_devices", lambda *_, **__: flown)

    def wrong() -> set[str]:
        return {finding.what for finding in verify_run(changed.path) if finding.right is False}

    assert wrong() == set()
    rewrite(changed.summary_file, '"validation_timed_out": ', '"validation_timed_out": 1')
    assert wrong() == {"summary.json from metrics.jsonl", "summary.json from the last checkpoint"}
    rewrite(changed.summary_file, '"validation_timed_out": 1', '"validation_timed_out": ')
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
        checkpoint.unlink()
    assert "last checkpoint" not in wrong()  # there is nothing left to compare
    summary = json.loads(changed.summary_file.read_text())
    for damaged in ({**summary, "devices": 3}, {"figures": "drawn"}):
        changed.write_summary(damaged)
        with pytest.raises(ConfigError, match="a file of the run in .* is not as a run writes it"):
            verify_run(changed.path)
    changed.write_summary(summary)
    rewrite(changed.summary_file, '"figures": "drawn"', '"figures": "to be drawn"')
    with pytest.raises(ConfigError, match="is not finished; continue it with edqn train"):
        verify_run(changed.path)


def rewrite(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


@pytest.mark.slow
def test_an_interrupted_run_that_is_continued_is_the_run_that_was_not(
    whole: tuple[RunDirectory, dict], tmp_path: Path
) -> None:
    uninterrupted, expected = whole
    run = RunDirectory(tmp_path / "cut")
    words = [sys.executable, "-c", KILLED, str(run.path)]
    with subprocess.Popen(words, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None and len(list(run.checkpoints.glob("step-*.safetensors"))) < 2:
            time.sleep(0.01)
        time.sleep(random.Random(0).uniform(0.0, 0.3))  # in a chunk, while it saves, or between
        assert process.poll() is None, process.communicate()[1]
        process.kill()
    # As if it had been killed while it wrote.
    with run.metrics_file.open("a") as file:
        file.write('{"decisions": 25')
    summary = train_run(TINY_RUN, dataclasses.replace(run, resume="must"), Progress(), Stop(), drawing=prepare_gallery)
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
    assert (policy, last) == (POLICY, "step-000000032.safetensors") and before.startswith("step-")


def _without_clocks(run: RunDirectory) -> list[dict]:
    return [{name: value for name, value in row.items() if "second" not in name} for row in run.read_metrics()]
