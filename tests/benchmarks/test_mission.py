"""The mission benchmark: what it runs, which seeds pass, what it adds up; and that no script measures in vain.

Nothing is trained here.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import mission
import tracking
import verdicts


def summary(**changes: Any) -> dict[str, Any]:
    """What a good run says."""
    good = {
        "outcome": "goal",
        "steps": 150,
        "path_length_m": 132.0,
        "shortest_path_m": 120.0,
        "min_clearance_m": 0.8,
        "train_seconds": 90.0,
        "compile_seconds": 20.0,
        "total_seconds": 148.0,
        "first_success_seconds": 60.0,
        "first_success_decisions": 250_000,
        "decisions_per_second": 6000.0,
        "validation_success": 0.95,
        "workload": {"width": 32},
        "versions": {"jax": "0"},
        "devices": ["cpu"],
    }
    return good | changes


def test_flags_after_two_dashes_go_to_training() -> None:
    args = mission.parse(["--seeds", "3", "--", "--agent.n-step", "3"])
    assert args.seeds == 3
    words = mission.command(args, 7, Path("runs/s7"))
    assert words[1].endswith("train.py")
    assert words[words.index("--seed") + 1] == "7"
    assert words[words.index("--run-dir") + 1] == "runs/s7"
    assert words[-2:] == ["--agent.n-step", "3"]


def test_quick_is_at_most_two_seeds_and_own_flags_win() -> None:
    args = mission.parse(["--quick", "--", "--total-steps", "1024"])
    assert args.seeds == 2
    # The last of two equal flags is the one that counts.
    assert args.flags[-2:] == ["--total-steps", "1024"]


def test_bad_input_ends_with_exit_code_2() -> None:
    with pytest.raises(SystemExit) as ending:
        mission.parse(["--seeds", "0"])
    assert ending.value.code == 2


@pytest.mark.parametrize(
    ("script", "works"),
    [(mission, "measure"), (tracking, "measure"), (verdicts, "fly_recorded")],
    ids=["mission", "tracking", "verdicts"],
)
def test_a_file_that_cannot_be_written_is_named_before_anything_is_measured(
    script: ModuleType,
    works: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(script, works, lambda *_: pytest.fail("it went to work"))
    file = tmp_path / "nowhere" / "rows.json"
    words = ["--json", str(file)] + (["run"] if script is verdicts else [])
    assert script.main(words) == 2
    assert capsys.readouterr().err == f"'{file}' cannot be written: there is no folder '{file.parent}'\n"


def test_a_good_run_passes() -> None:
    row = mission.row_of(0, summary(), 150.0)
    assert row["passes"]
    assert row["path_over_shortest"] == pytest.approx(1.1)


@pytest.mark.parametrize(
    ("changes", "wall", "missed"),
    [
        ({"outcome": "collision"}, 150.0, {"goal", "decisions_ok", "path_ok"}),
        ({"steps": 189}, 150.0, {"decisions_ok"}),
        ({"path_length_m": 138.1}, 150.0, {"path_ok"}),
        ({}, 180.0, {"time_ok"}),
        ({}, None, {"time_ok"}),
    ],
)
def test_each_bar_fails_a_seed_alone(changes: dict[str, Any], wall: float | None, missed: set[str]) -> None:
    row = mission.row_of(0, summary(**changes), wall)
    bars = ("goal", "decisions_ok", "path_ok", "time_ok")
    assert {bar for bar in bars if not row[bar]} == missed
    assert not row["passes"]


def test_the_very_limits_still_pass() -> None:
    assert mission.row_of(0, summary(steps=188, path_length_m=115.0, shortest_path_m=100.0), 179.9)["passes"]


def test_the_time_to_a_policy_counts_from_typing_and_seeds_without_one() -> None:
    flies = mission.row_of(0, summary(), 150.0)
    assert flies["flies_seconds"] == pytest.approx(62.0)
    never = mission.row_of(1, summary(first_success_seconds=None, first_success_decisions=None), 150.0)
    assert mission.totals([flies, flies, never])["median_flies_seconds"] == pytest.approx(62.0)
    assert mission.totals([flies, never, never])["median_flies_seconds"] is None


def test_totals_count_failed_trainings_but_take_medians_of_flights() -> None:
    rows = [
        mission.row_of(0, summary(steps=140), 100.0),
        mission.row_of(1, summary(steps=160), 120.0),
        mission.row_of(2, summary(steps=200, outcome="time_out"), 130.0),
        mission.failed_row(3, 3, 40.0),
    ]
    total = mission.totals(rows)
    assert (total["seeds"], total["goal"], total["passes"]) == (4, 2, 2)
    assert total["median_decisions"] == 150
    assert total["median_wall_seconds"] == 110.0
    # Wilson's interval of 2 in 4, by hand: z^2 = 3.8415, middle (0.5 + z^2 / 8) / (1 + z^2 / 4) = 0.5.
    assert total["passes_interval"] == pytest.approx([0.150, 0.850], abs=1e-3)
    text = mission.table(rows) + mission.sentences(total)
    assert "exit code 3" in text and "2 of 4 seeds pass" in text


def test_no_seed_is_trained_twice_whether_it_ended_well_or_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trained = []

    def train(words: list[str], **_: Any) -> subprocess.CompletedProcess[bytes]:
        folder = Path(words[words.index("--run-dir") + 1])
        trained.append(folder.name)
        if folder.name == "s1":
            return subprocess.CompletedProcess(words, 3)
        folder.mkdir()
        (folder / "summary.json").write_text(json.dumps(summary()))
        return subprocess.CompletedProcess(words, 0)

    monkeypatch.setattr(mission.subprocess, "run", train)
    words = ["--seeds", "2", "--out", str(tmp_path), "--json", str(tmp_path / "all.json")]
    assert mission.main(words) == 0
    assert mission.main(["--seeds", "3", *words[2:]]) == 0
    assert trained == ["s0", "s1", "s2"]
    report = json.loads((tmp_path / "all.json").read_text())
    assert [row["name"] for row in report["rows"]] == ["seed 0", "seed 1", "seed 2"]
    assert report["totals"]["passes"] == 2
    assert report["workload"]["width"] == 32 and report["device"] and report["versions"]
    assert mission.main([*words, "--", "--agent.n-step", "3"]) == 2
    assert "another --out" in capsys.readouterr().err


def test_the_script_explains_itself(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ending:
        mission.parse(["--help"])
    assert ending.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "--seeds" in shown and "one seed after another" in shown
