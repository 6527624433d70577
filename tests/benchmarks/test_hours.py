"""The table of runs at several hours."""

from __future__ import annotations

from pathlib import Path

import pytest

import throughput
from edqn_jax.errors import ConfigError
from measurement import hours
from tests.support.pages import ROOT

SEEN = {"cores_busy_with_others": None, "steal": 0.0123, "product_flops": 2e11}


def report(device: str, rate: float, ratio: float, compiling: float) -> dict:
    return {
        "device": device,
        "conditions": SEEN,
        "decisions_per_second": rate,
        "compile_seconds": compiling,
        "rows": [{"over_c_mujoco_rollout": ratio}],
    }


def test_runs_come_back_as_they_were_added_and_their_medians_are_of_one_processor_and_options(tmp_path: Path) -> None:
    file = tmp_path / "hours.tsv"
    added = []
    for processor, options, figures in (
        ("a", [], (10_000, 0.2, 8)),
        ("a", [], (31_000, 0.31, 9.5)),
        ("b", [], (1, 9, 1)),
        ("a", ["--num-envs", "64"], (2, 8, 2)),
        ("a", [], (20_000, 0.25, 12)),
    ):
        row = hours.row_of(report(processor, *figures), options)
        added.append(row)
        assert hours.add(file, row) == added == hours.read(file)
    assert added[0]["steal"] == "0.0123" and added[0]["cores_busy_with_others"] == "-"
    assert added[3]["options"] == "--num-envs 64"
    for number, day in ((1, "2026-01-02"), (4, "2026-01-03")):
        added[number]["time"] = f"{day} 11:00"
    assert hours.summary(added, added[0]) == (
        "Median of 3 runs on 3 days on this processor, with minimum and maximum: "
        "20,000 decisions/s (10,000 to 31,000), 0.250 of C MuJoCo's rate (0.200 to 0.310), "
        "9.5 s of compiling (8.0 to 12.0)."
    )
    assert "1 run on 1 day on" in hours.summary(added, added[2])


def test_a_short_turn_is_not_added(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="leave out --quick or --hours"):
        throughput.parse(["--quick", "--hours", str(tmp_path / "hours.tsv")])


def test_the_page_says_what_the_table_says() -> None:
    rows = hours.read(ROOT / "benchmarks/hours.tsv")
    page = (ROOT / "docs/performance.md").read_text(encoding="utf-8")
    for row in rows:  # a line for each processor
        assert f"> {hours.summary(rows, row)}\n" in page


@pytest.mark.parametrize("text", ["a,b\n", "\t".join(hours.FIELDS) + "\nshort\trow\n"])
def test_what_is_no_table_of_runs_is_refused_before_anything_is_timed(text: str, tmp_path: Path) -> None:
    file = tmp_path / "other.tsv"
    file.write_text(text)
    with pytest.raises(ConfigError, match="is no table of runs; its first line must be time commit"):
        throughput.parse(["--hours", str(file)])
    assert file.read_text() == text
