"""What the screen says at the end of a run: success over many missions, and what to do next."""

from __future__ import annotations

import dataclasses
import shlex
from pathlib import Path
from typing import Any

import pytest

from edqn_jax.cli.evaluate import parse_evaluate
from edqn_jax.cli.report import parse_report
from edqn_jax.cli.train import parse_train
from edqn_jax.config.loading import make_config, to_yaml
from edqn_jax.runs.directory import RunDirectory
from edqn_jax.runs.messages import describe_stop, verdict

CONFIG = make_config("medium", train={"total_steps": 4096, "validation_missions": 64})
FLOWN = 5120  # whole chunks, more than was asked for

ONE: dict[str, Any] = {
    "outcome": "collision",
    "steps": 12,
    "flight_seconds": 3.1,
    "path_length_m": 6.0,
    "shortest_path_m": 40.0,
    "min_clearance_m": 0.0,
    "world": "medium",
    "flown": "paper",
    "validation_success": 0.75,
    "parameters_from_decisions": 4096,
    "total_seconds": 70.0,
    "train_seconds": 60.0,
    "train_decisions": FLOWN,
}

SEEDS: dict[str, Any] = {
    "seeds": [3, 4],
    "success_rates": [0.5, 0.25],
    "success_interval": [0.1, 0.7],
    "success_iqm": 0.4,
    "success_mean": 0.375,
    "missions": 63,
    "world": "medium",
    "flown": "paper",
    "flown_successes": 1,
    "total_seconds": 70.0,
    "train_seconds": 60.0,
    "train_decisions": FLOWN,
}


def test_a_run_ends_with_its_success_over_the_validation_missions_before_one_flight() -> None:
    first, second, *_ = verdict(ONE, RunDirectory(Path("here")), CONFIG).splitlines()
    assert first == "Validation: 75% of 64 missions reached the goal, after 4,096 decisions of training."
    assert second.startswith(
        "The greedy flight through the paper's map, which training never used, ended in a collision"
    )


def test_the_time_of_a_run_that_was_continued_is_said_to_be_that_of_all_its_sessions() -> None:
    run = RunDirectory(Path("here"))
    for summary in (ONE, SEEDS):
        assert "Took 1:10 in all, 1:00 of it training. " in verdict(summary, run, CONFIG)
        continued = verdict({**summary, "resumed_at_decisions": [2048]}, run, CONFIG)
        assert "Took 1:10 in all, 1:00 of it training, over all of its sessions. " in continued


def test_a_run_that_ends_in_hovering_says_how_it_may_fly() -> None:
    def second_line(share: float, price: float, left: float | None = None) -> str:
        prices = {"collision_reward": price, "left_volume_reward": price if left is None else left}
        config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, **prices))
        return verdict(ONE | {"validation_timed_out": share}, RunDirectory(Path("here")), config).splitlines()[1]

    assert second_line(0.62, -60.0) == (
        "62% ran out of time: where a collision costs much, a policy may learn to hover. Try a lower price, with "
        "--env.collision-reward -20 --env.left-volume-reward -20."
    )
    assert second_line(0.62, -60.0, left=0.0).endswith("with --env.collision-reward -20.")  # none is raised
    assert second_line(0.4, -60.0).startswith("The greedy flight") and second_line(0.9, -9.0).startswith("The greedy")


@pytest.mark.parametrize(("summary", "flies"), [(ONE, ""), (SEEDS, "seed-3")])
def test_the_last_lines_are_commands_that_work_in_any_folder(
    summary: dict[str, Any], flies: str, tmp_path: Path
) -> None:
    run = RunDirectory(tmp_path / "of mine")
    for folder in (run.path, run.path / flies):
        folder.mkdir(exist_ok=True)
        (folder / "config.yaml").write_text(to_yaml(CONFIG))
    lines = verdict(summary, run, CONFIG).splitlines()[-3:]
    report, evaluate, train = (shlex.split(line.partition(":")[2]) for line in lines)
    assert [words[:2] for words in (report, evaluate, train)] == [
        ["edqn", each] for each in ("report", "evaluate", "train")
    ]
    assert parse_report(report[2:]).runs == (run.path,)
    assert parse_evaluate(evaluate[2:]).run == run.path / flies
    options, config = parse_train(train[2:])
    assert (options.run_dir, config.train.total_steps) == (run.path, 2 * FLOWN)


def test_the_next_commands_import_what_this_one_did(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edqn_jax.runs.messages.IMPORTED", ["my sensor.py", "mine"])
    lines = verdict(ONE, RunDirectory(Path("here")), CONFIG).splitlines()[-3:]
    for line in (*lines, describe_stop(RunDirectory(Path("here")), 2048, None)):
        assert " --import 'my sensor.py' --import mine" in line


def test_a_run_that_was_stopped_names_the_command_that_resumes_it() -> None:
    said = describe_stop(RunDirectory(Path("runs/of mine")), 2048, None)
    assert said.endswith("; edqn train --run-dir 'runs/of mine' goes on from there") and "\n" not in said
    assert "edqn train --run-dir here goes" in describe_stop(RunDirectory(Path("here")), 2048, 2)
    assert "edqn train" not in describe_stop(None, 2048, None)
