"""Rows of success: measured once, found again, and as many as there is time for."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path

import numpy as np
import pytest

import success
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.runs.policies import load_policy, save_policy
from tests.support.benchmarks.untrained_runs import SMALL, untrained


def call(out: Path, *words: str) -> int:
    arguments = ["--out", str(out), "--worlds", "sparse", "--sensors", "blind", "--seeds", "2", "--missions", "3"]
    return success.main([*arguments, *words, "--", *SMALL])


def test_what_one_call_trains_another_flies(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(success, "use_cpu_devices", lambda count: None)
    monkeypatch.setattr(success, "train_seeds", untrained)
    assert call(tmp_path, "--train-only") == 3
    (folder,) = (tmp_path / "policies").iterdir()
    assert "trained" in capsys.readouterr().err and not list(tmp_path.glob("*.json"))
    monkeypatch.setattr(success, "train_seeds", lambda *_: pytest.fail("trained again"))
    assert call(tmp_path, "--train-only") == 3
    assert call(tmp_path, "--no-spl") == 0
    (file,) = tmp_path.glob("sparse-blind-*.json")
    row = json.loads(file.read_text())
    assert file.stem == folder.name and row["training"]["policies"] == ["seed-0", "seed-1"]
    assert row["decisions"] == 256 and [turn["seed"] for turn in row["turns"]] == [0, 1]
    (folder / success.TRAINED).unlink()  # as if the training had been cut short
    file.unlink()
    with pytest.raises(pytest.fail.Exception, match="trained again"):
        call(tmp_path, "--no-spl")


def test_a_training_that_another_process_does_is_left_to_it(tmp_path: Path) -> None:
    taken, free = tmp_path / "rows" / "a-b-1.json", tmp_path / "rows" / "a-b-2.json"
    done: list[Path] = []
    wanted = [
        success.Wanted(file, lambda: {}, functools.partial(done.append, success.policies_of(file)))
        for file in (taken, free)
    ]
    taken.parent.mkdir()
    with success._claim(taken) as ours:
        assert ours
        success.train_all(wanted, 1e12)
        assert done == [success.policies_of(free)]
    success.train_all(wanted[:1], 1e12)
    assert done[1:] == [success.policies_of(taken)]


@pytest.mark.slow
def test_a_row_is_measured_once_and_then_read(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(success, "use_cpu_devices", lambda count: None)
    monkeypatch.setattr(success, "train_seeds", untrained)
    # There is no time for a row: nothing is begun, and the exit code says so.
    assert call(tmp_path, "--minutes", "0.01", "--no-spl") == 3
    assert "1 rows are left" in capsys.readouterr().err and not list(tmp_path.glob("*.json"))
    assert call(tmp_path) == 0
    shown = capsys.readouterr().out
    (file,) = tmp_path.glob("sparse-blind-*.json")
    row = json.loads(file.read_text())
    assert [turn["seed"] for turn in row["turns"]] == [0, 1] and len(row["turns"][1]["flights"]["outcome"]) == 3
    assert load_policy(tmp_path / "policies" / file.stem / "seed-1").config.train.seed == 1
    assert "| sparse | blind | 2 x 3 | 0.00% |" in shown
    assert len(json.loads((tmp_path / "shortest_sparse_3_0.36.json").read_text())["lengths"]) == 3
    monkeypatch.setattr(success, "train_row", lambda *_: pytest.fail("measured again"))
    assert call(tmp_path) == 0 and capsys.readouterr().out == shown
    # A row of other code is another row.
    monkeypatch.setattr(success, "commit", lambda: "0123456")
    assert call(tmp_path, "--minutes", "0.01", "--no-spl") == 3


def test_other_options_make_another_row() -> None:
    config = success.config_of("sparse", "blind", SMALL)
    assert config.train.keep == "last" and config.train.validation_every == 0
    other = success.config_of("sparse", "blind", [*SMALL, "--agent.n-step", "2"])
    names = {
        success.row_file(Path("x"), config, 1000, "5").name,
        success.row_file(Path("x"), config, 1000, "4").name,
        success.row_file(Path("x"), config, 100, "5").name,
        success.row_file(Path("x"), success.config_of("sparse", "depth", SMALL), 1000, "5").name,
        success.row_file(Path("x"), other, 1000, "5").name,
    }
    assert len(names) == 5


@pytest.mark.slow
def test_existing_runs_make_a_row_of_their_own(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(success, "use_cpu_devices", lambda count: None)
    trained = success.config_of("sparse", "blind", SMALL)
    runs = [tmp_path / f"seed-{seed}" for seed in (0, 1)]
    for seed, run in enumerate(runs):
        own = dataclasses.replace(trained, train=dataclasses.replace(trained.train, seed=seed))
        save_policy(Policy(own, fresh_policy(own, seed)), run)
    words = ["--out", str(tmp_path / "rows"), "--missions", "3", "--no-spl", "--worlds", "medium", "--runs"]
    assert success.main([*words, str(runs[0])]) == 2
    assert f"'{runs[0]}' holds no summary.json" in capsys.readouterr().err
    for run in runs:
        took = {"train_seconds": 2.0, "compile_seconds": 1.0, "train_decisions": 256}
        (run / "summary.json").write_text(json.dumps(took))
    code = success.main([*words, *map(str, runs)])
    assert code == 0, capsys.readouterr().err
    assert "| medium, trained in sparse | blind | 2 x 3 | 0.00% |" in capsys.readouterr().out
    (file,) = (tmp_path / "rows").glob("medium-blind-*.json")
    row = json.loads(file.read_text())
    assert [turn["seed"] for turn in row["turns"]] == [0, 1] and row["train_seconds"] == 4.0
    assert row["trained_in"] == "sparse" and row["runs"] == [str(run) for run in runs]
    # Runs of one program have its time, and are the same row in another order.
    together = [{"train_seconds": 9.0, "compile_seconds": 1.0, "trained_together": 2}] * 2
    monkeypatch.setattr(success, "_summary", lambda run: {**together[0], "train_decisions": 256})
    assert success.fly_row(success.config_of("medium", "blind", SMALL), [load_policy(r) for r in runs], runs, 3)[
        "train_seconds"
    ] == pytest.approx(9.0)
    monkeypatch.undo()
    monkeypatch.setattr(success, "use_cpu_devices", lambda count: None)
    monkeypatch.setattr(success, "fly_row", lambda *_: pytest.fail("measured again"))
    assert success.main([*words, *map(str, reversed(runs))]) == 0
    monkeypatch.undo()
    monkeypatch.setattr(success, "use_cpu_devices", lambda count: None)
    # Other policies are another row, so are codes of other drones; policies of another training are none at all.
    assert success.main([*words, str(runs[1])]) == 0
    assert success.main([*words, str(runs[1]), "--shuffle-codes"]) == 0
    assert "| medium, trained in sparse, codes of another drone | blind | 1 x 3 |" in capsys.readouterr().out
    assert len(list((tmp_path / "rows").glob("medium-*.json"))) == 3
    other = dataclasses.replace(trained, agent=dataclasses.replace(trained.agent, n_step=2))
    save_policy(Policy(other, fresh_policy(other, 0)), tmp_path / "other")
    capsys.readouterr()
    assert success.main([*words, str(runs[0]), str(tmp_path / "other")]) == 2
    assert "must have the same options but train.seed" in capsys.readouterr().err


def test_figures_are_of_all_seeds_and_missions() -> None:
    flights = [
        {"outcome": ["goal", "goal", "collision", "goal"], "path_length_m": [50.0, 60.0, 10.0, 40.0]},
        {"outcome": ["goal", "collision", "collision", "goal"], "path_length_m": [55.0, 9.0, 10.0, 80.0]},
    ]
    row = {"turns": [{"seed": k, "flights": columns} for k, columns in enumerate(flights)]}
    found = success.figures(row, np.array([50.0, 50.0, 50.0, np.nan]))
    assert found["success"] == pytest.approx(0.625) and found["rates"] == [0.75, 0.5]
    # Where the shortest path is unknown, the flown one stands in for it.
    assert found["spl"] == pytest.approx(((1 + 50 / 60 + 1) / 4 + (50 / 55 + 1) / 4) / 2)
    assert success.figures(row, None)["spl"] is None


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--out", "here", "--", "--no-such-flag"], "there is no option '--no-such-flag'"),
        (["--out", "here", "--", "--num-envs", "-1"], "train.num_envs"),
    ],
)
def test_bad_options_are_a_sentence(words: list[str], says: str, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert success.main(words) == 2
    assert says in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_foreign_file_among_the_rows_is_named(tmp_path: Path, capsys) -> None:
    (tmp_path / "a-b-c.json").write_text("not json")
    assert success.main(["--out", str(tmp_path), "--report"]) == 2
    assert "is not a row that this benchmark wrote" in capsys.readouterr().err
