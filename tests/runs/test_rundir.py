"""The directory that a run writes."""

from __future__ import annotations

import dataclasses
import json
from importlib.metadata import version
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import Config, TrainConfig
from edqn_jax.config.loading import resolve_config
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.trajectories import TRAJECTORY_COLUMNS, trajectory_columns
from edqn_jax.runs.directory import TO_BE_DRAWN, RunDirectory, plan_run_directory, version_of


def begin(run: RunDirectory, seeds: list[Config] | None = None) -> None:
    with run.hold_lock():
        run.begin(seeds or [Config()], seeds is not None)


@pytest.fixture
def run(tmp_path) -> RunDirectory:
    run = plan_run_directory(tmp_path / "run", Config())
    begin(run)
    return RunDirectory(run.path)


def test_planning_makes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plan_run_directory(Path("deep/down/run"), Config())
    plan_run_directory(None, Config())
    assert list(tmp_path.iterdir()) == []


def test_a_fresh_folder_is_dated_names_world_and_seed_and_is_never_an_old_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = resolve_config(world="medium")
    first = plan_run_directory(None, config)
    begin(first)
    second = plan_run_directory(None, config)
    assert first.path.parent == Path("runs") and first.path.name.endswith("-medium-s0")
    assert second.path.name == f"{first.path.name}-2"


def test_of_two_runs_that_plan_the_same_fresh_folder_one_gets_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = plan_run_directory(None, Config())  # both of them, each before the other is there
    begin(run)
    run.append_metrics({"decisions": 1})
    with pytest.raises(ConfigError, match=f"another run has just created '{run.path}'; start this one again"):
        begin(run)
    assert run.read_metrics() == [{"decisions": 1}]


def test_the_resolved_configuration_reads_back(run):
    assert resolve_config(file=run.config_file) == Config()


def test_a_foreign_folder_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ConfigError, match="not an edqn run"):
        plan_run_directory(tmp_path, Config())
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("theirs", ["model: {layers: 3}\n", "train: {optimiser: adam}\n", "train: {\n", "- 1\n"])
@pytest.mark.parametrize("resume", ["auto", "never", "must"])
def test_a_config_that_is_not_ours_makes_no_run(theirs, resume, tmp_path):
    (tmp_path / "config.yaml").write_text(theirs)
    with pytest.raises(ConfigError, match="not an edqn run"):
        plan_run_directory(tmp_path, Config(), resume)
    assert (tmp_path / "config.yaml").read_text() == theirs


def test_a_finished_run_is_refused_whatever_resume_says(run):
    run.write_summary({"success": True, "figures": "drawn"})
    for resume in ("auto", "never", "must"):
        with pytest.raises(ConfigError, match="finished run"):
            plan_run_directory(run.path, Config(), resume)


def test_an_unfinished_run_is_continued_unless_it_is_to_be_started_over(run):
    run.append_metrics({"decisions": 1})
    run.append_episodes([(10, 1.0, 5, "goal")])
    assert [plan_run_directory(run.path, Config(), resume).resume for resume in ("auto", "must")] == ["auto", "must"]
    again = plan_run_directory(run.path, Config(), "never")
    assert again.resume == "never" and again.metrics_file.exists()
    begin(again)
    assert not again.metrics_file.exists()
    assert len(again.read_episodes()["step"]) == 0


def test_a_run_that_ended_before_its_figures_were_drawn_is_continued(run):
    run.write_summary({"success": True, "figures": TO_BE_DRAWN})
    assert plan_run_directory(run.path, Config()).resume == "auto"
    run.summary_file.write_text("{")  # nobody knows what it was: it stays
    with pytest.raises(ConfigError, match="finished run"):
        plan_run_directory(run.path, Config(), "never")


def test_what_another_run_made_meanwhile_is_not_deleted(tmp_path):
    config = Config()
    first, second = (plan_run_directory(tmp_path, config, resume) for resume in ("auto", "never"))
    begin(first)
    for late in (first, second):
        with pytest.raises(ConfigError, match="another run was made in .* meanwhile; give another folder"):
            begin(late)
    over = plan_run_directory(tmp_path, config, "never")
    first.write_summary({"success": True})
    with pytest.raises(ConfigError, match="another run was made"):
        begin(over)


def test_a_run_holds_results_once_there_is_anything_of_it(run):
    assert not run.holds_results
    (run.checkpoints / "step-000000001.safetensors.damaged").touch()
    assert run.holds_results


def test_a_finished_run_is_continued_for_more_decisions(run):
    run.write_summary({"success": True, "figures": "drawn"})
    more = dataclasses.replace(Config(), train=TrainConfig(total_steps=10**6))
    assert plan_run_directory(run.path, more).resume == "auto"
    with dataclasses.replace(run, resume="auto").hold_lock():
        run.reopen([more])
    assert not run.summary_file.exists() and resolve_config(file=run.config_file) == more


def test_resume_must_needs_a_run(tmp_path):
    with pytest.raises(ConfigError, match="there is no run to continue"):
        plan_run_directory(tmp_path / "new", Config(), "must")


def test_an_empty_folder_is_welcome(tmp_path):
    assert plan_run_directory(tmp_path, Config()).path == tmp_path


@pytest.mark.parametrize("below", ["file", "file/run", "file/deep/run"])
def test_a_file_in_the_way_is_named(below, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="file"):
        plan_run_directory(tmp_path / below, Config())


@pytest.mark.parametrize("given", [Path("run"), None])
def test_a_place_without_the_right_to_write_is_named(given, tmp_path, monkeypatch):
    # The tests may run as root, who may write anywhere; so the answer of the system is made up.
    def refuse(**_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("edqn_jax.files.tempfile.mkdtemp", refuse)
    with pytest.raises(ConfigError, match=f"'{given or 'runs'}' cannot be written: .*Permission denied"):
        plan_run_directory(given, Config())


def test_what_fails_only_when_made_is_a_sentence_too(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written"):
        begin(RunDirectory(tmp_path / "file" / "run"))


@pytest.mark.parametrize("inside", ["", "figures"])
def test_a_file_where_a_folder_must_be_is_named_and_left_alone(inside, tmp_path):
    run = RunDirectory(tmp_path / "run")
    file = run.path / inside
    file.parent.mkdir(exist_ok=True)
    file.write_text("years of work")
    with pytest.raises(ConfigError, match=f"'{run.path}' cannot be written: '{file}' is in the way; move it away"):
        begin(run)
    assert file.read_text() == "years of work"


def test_numbers_of_numpy_and_jax_become_json_and_what_is_not_finite_null(run):
    run.append_metrics({"decisions": np.int64(3), "q_loss": jnp.float32(0.5), "kl": float("nan")})
    run.append_metrics({"shares": np.array([1.0, np.inf]), "phase": "learning"})
    lines = run.metrics_file.read_text().splitlines()
    assert [json.loads(line) for line in lines] == run.read_metrics()
    assert run.read_metrics()[0] == {"decisions": 3, "q_loss": 0.5, "kl": None}
    assert run.read_metrics()[1] == {"shares": [1.0, None], "phase": "learning"}


def test_episodes_are_appended_and_read_back_by_column(run):
    run.append_episodes([(np.int64(256), np.float32(99.5), 12, "goal")])
    run.append_episodes([(512, -100.0, 3, "collision")])
    assert run.episodes_file.read_text() == "step,return,length,outcome\n256,99.5,12,goal\n512,-100,3,collision\n"
    episodes = run.read_episodes()
    assert episodes["length"].tolist() == [12, 3] and episodes["outcome"].tolist() == ["goal", "collision"]


def test_the_trajectory_has_the_columns_that_others_rely_on(run):
    run.write_trajectory({name: np.full(2, index) for index, name in enumerate(TRAJECTORY_COLUMNS)})
    header, row, _ = run.trajectory_file.read_text().splitlines()
    assert header == "t,x,y,z,qw,qx,qy,qz,vx,vy,vz,action,reward,clearance"
    assert row == ",".join(map(str, range(14)))
    columns = trajectory_columns(3)
    run.write_trajectory({name: np.full(2, index) for index, name in enumerate(columns)})
    held = run.read_trajectory()
    assert tuple(held) == columns and "action" not in held and held["action_2"].tolist() == [13, 13]
    run.trajectory_file.write_text(run.trajectory_file.read_text().replace("action_1", "action_3"))
    with pytest.raises(ValueError, match="columns of a flight"):
        run.read_trajectory()


def test_a_summary_that_cannot_be_written_leaves_the_old_one(run):
    run.write_summary({"success": np.bool_(True)})
    with pytest.raises(TypeError):
        run.write_summary({"success": object()})
    assert json.loads(run.summary_file.read_text()) == {"success": True}


def test_one_seed_and_several_leave_nothing_of_each_other(tmp_path):
    run, configs = RunDirectory(tmp_path / "run"), [Config(train=TrainConfig(seed=seed)) for seed in (0, 1)]
    begin(run)
    run.append_metrics({"decisions": 1})
    begin(run, configs)
    assert sorted(file.name for file in run.path.iterdir()) == ["checkpoints", "config.yaml", "seed-0", "seed-1"]
    assert run.of_seed(0).figures.is_dir()
    begin(run)
    assert not list(run.path.glob("seed-*")) and run.checkpoints.is_dir()


def test_a_configuration_says_which_version_wrote_it(run, tmp_path):
    begin(run)
    assert version_of(run.config_file) == version("edqn-jax")
    run.config_file.write_bytes(b"\xff\xfe")
    assert version_of(run.config_file) is None and version_of(tmp_path / "nothing") is None
