"""Which run a folder holds, and with which options it is continued."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from edqn_jax.cli.train import parse_train
from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.errors import ConfigError
from edqn_jax.learn.schedule import Schedule
from edqn_jax.runs.continuation import option_differences
from edqn_jax.runs.directory import RunDirectory, plan_run_directory


@pytest.fixture
def run(tmp_path: Path) -> RunDirectory:
    """An unfinished run that was started with --world paper --agent.n-step 5."""
    run = RunDirectory(tmp_path / "run")
    _, config = parse_train(["--world", "paper", "--agent.n-step", "5"])
    with run.hold_lock():
        run.begin([config])
    return run


def asked(run: RunDirectory, *argv: str) -> Config:
    return parse_train([*argv, "--run-dir", str(run.path)])[1]


@pytest.mark.parametrize("again", [[], ["--world", "paper", "--agent.n-step", "5"], ["--seed", "0"]])
def test_a_run_goes_on_with_its_own_options(run: RunDirectory, again: list[str]) -> None:
    config = asked(run, *again)
    assert config == make_config("paper", agent={"n_step": 5})
    assert plan_run_directory(run.path, config).resume == "auto"


def test_other_options_are_refused_one_by_one(run: RunDirectory) -> None:
    says = r"other options: agent.n_step was 5 and is now 4; train.seed was 0 and is now 1; leave them out"
    with pytest.raises(ConfigError, match=says):
        asked(run, "--agent.n-step", "4", "--seed", "1")
    with pytest.raises(ConfigError, match=r"world.name was paper and is now medium"):
        asked(run, "--preset", "default")
    assert asked(run, "--resume", "never", "--seed", "1").train.seed == 1  # begins anew


@pytest.mark.parametrize(
    ("flags", "changed"),
    [
        (["--train.devices", "1"], {"devices": 1}),
        (["--train.checkpoints", "5"], {"checkpoints": 5}),
        (["--total-steps", "700000"], {"total_steps": 700_000, "schedule_steps": 500_000}),
    ],
)
def test_what_changes_nothing_before_may_change(run: RunDirectory, flags: list[str], changed: dict[str, Any]) -> None:
    before = asked(run)
    assert asked(run, *flags) == dataclasses.replace(before, train=dataclasses.replace(before.train, **changed))


def test_a_longer_run_keeps_the_schedule_of_its_first_length(run: RunDirectory) -> None:
    with run.hold_lock():
        run.reopen([asked(run, "--total-steps", "700000")])
    twice = asked(run, "--total-steps", "900000")
    assert (twice.train.total_steps, twice.train.schedule_steps) == (900_000, 500_000)
    with pytest.raises(ConfigError, match=r"is of 700,000 decisions, so --total-steps must be at least that"):
        asked(run, "--total-steps", "500000")


def test_the_schedule_of_a_longer_run_is_that_of_the_shorter_one() -> None:
    short = make_config("medium")
    long = make_config("medium", train={"total_steps": 3_000_000, "schedule_steps": short.train.total_steps})
    plans = [Schedule.from_config(config) for config in (short, long)]
    assert plans[1].total > plans[0].total == plans[1].scheduled
    assert dataclasses.replace(plans[1], total=plans[0].total) == plans[0]


def test_the_number_of_seeds_is_the_runs(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    configs = [make_config("paper", train={"seed": seed}) for seed in (0, 1)]
    with run.hold_lock():
        run.begin(configs, seeds=True)
    assert parse_train(["--run-dir", str(run.path)])[0].seeds == 2
    with pytest.raises(ConfigError, match="holds runs of 2 seeds, not runs of 3 seeds; leave --seeds out to continue"):
        parse_train(["--run-dir", str(run.path), "--seeds", "3"])


def test_an_empty_configuration_is_not_taken_for_the_defaults(run: RunDirectory) -> None:
    run.config_file.write_text("")
    with pytest.raises(ConfigError, match=r"config.yaml' is empty: it does not say what the run in .* is"):
        asked(run)


def test_differences_are_named_as_in_a_file() -> None:
    one, other = make_config("paper"), make_config("paper", agent={"n_step": 7}, train={"seed": 3})
    assert option_differences(one, other) == ["agent.n_step", "train.seed"] and not option_differences(one, one)
