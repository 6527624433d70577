"""Two commits side by side: which commits may be compared, how turns are taken, what a ratio's interval is."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import compare
from edqn_jax.errors import ConfigError
from edqn_jax.learn.trainer import Trainer
from measurement import worker
from measurement.whole import WHOLE
from tests.support.miniature import MINIATURE

ROOT = Path(__file__).resolve().parents[2]
STUB = """
import json
import sys

import edqn_jax

wanted, costs = json.loads(sys.argv[1]), {costs}
about = {{
    "package": edqn_jax.__file__,
    "rows": [row for row in costs if not wanted or row in wanted],
    "workload": {{
        "num_envs": int(sys.argv[sys.argv.index("--num-envs") + 1]),
        "sensor": "frames" if "frames" in sys.argv else "events",
    }},
    "device": "a machine",
    "devices": ["cpu:0"],
    "versions": {{}},
}}
print(json.dumps(about), flush=True)
for line in sys.stdin:
    print(costs[line.strip()], flush=True)
"""
"""A worker that compiles nothing."""

OLD, NEW = (Path(worker) for worker in ("benchmarks/worker.py", "benchmarks/measurement/worker.py"))


def git(folder: Path, *words: str) -> str:
    named = ["-c", "user.name=A Tester", "-c", "user.email=tester@example.org"]
    return subprocess.run(
        ["git", "-C", str(folder), *named, *words], check=True, capture_output=True, text=True
    ).stdout.strip()


def commit(folder: Path, message: str) -> None:
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--message", message)


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """Three commits: without a worker, with a slow one in its older place, with one in its new place, twice as fast."""
    folder = tmp_path / "repository"
    (folder / NEW.parent).mkdir(parents=True)
    git(folder, "init", "--quiet")
    for name in ("edqn_jax", "scenes"):
        (folder / name).symlink_to(ROOT / name)
    commit(folder, "no worker")
    for tag, place, cost in (("slow", OLD, 80.0), ("fast", NEW, 40.0)):
        for old in (OLD, NEW):
            (folder / old).unlink(missing_ok=True)
        (folder / place).write_text(STUB.format(costs={WHOLE: cost, "acting": cost / 10}))
        commit(folder, tag)
        git(folder, "tag", tag)
    return folder


def test_an_unknown_commit_is_told_in_a_sentence(repository: Path) -> None:
    assert compare.find_commit(repository, "fast") == git(repository, "rev-parse", "HEAD")
    with pytest.raises(ConfigError, match="there is no commit 'slaw' in"):
        compare.find_commit(repository, "slaw")
    with pytest.raises(ConfigError, match="'fast~2' cannot be compared: it is older than compare.py"):
        compare.find_commit(repository, "fast~2")


def test_a_dirty_tree_matters_only_to_the_commit_that_is_checked_out(repository: Path) -> None:
    slow, fast = (compare.find_commit(repository, name) for name in ("slow", "fast"))
    compare.check_committed(repository, {"slow": slow, "HEAD": fast})
    (repository / "notes.txt").write_text("nothing that is timed")
    compare.check_committed(repository, {"slow": slow, "HEAD": fast})
    (repository / NEW).write_text("something else")
    compare.check_committed(repository, {"slow": slow})
    with pytest.raises(ConfigError, match="'HEAD' is checked out here with uncommitted changes, .*worker.py'"):
        compare.check_committed(repository, {"slow": slow, "HEAD": fast})


def test_a_worktree_holds_the_commit_and_leaves_nothing_behind(repository: Path, tmp_path: Path) -> None:
    slow = compare.find_commit(repository, "slow")
    with compare.check_out(repository, slow, tmp_path / "a") as checkout:
        assert (checkout / OLD).is_file() and not (checkout / NEW).exists()
    assert not (tmp_path / "a").exists()
    assert len(git(repository, "worktree", "list").splitlines()) == 1


def test_workers_take_turns_there_and_back() -> None:
    asked = []

    class Fake(compare.Worker):
        def __init__(self, name: str) -> None:
            self.name = name

        def ask(self, row: str) -> float:
            asked.append(self.name + row)
            return float(len(asked))

    turns = compare.take_turns([Fake("A"), Fake("B")], ["x", "y"], 3)
    assert asked == ["Ax", "Bx", "Ay", "By", "Bx", "Ax", "By", "Ay", "Ax", "Bx", "Ay", "By"]
    assert turns == {"x": [[1.0, 6.0, 9.0], [2.0, 5.0, 10.0]], "y": [[3.0, 8.0, 11.0], [4.0, 7.0, 12.0]]}


def test_a_ratio_is_the_median_of_pairs_so_a_slow_minute_that_hits_both_does_not_count() -> None:
    row = compare.compared("physics", [10.0, 10.0, 30.0, 50.0, 10.0], [9.0, 9.0, 27.0, 45.0, 9.0])
    assert (row["ratio"], row["ratio_low"], row["ratio_high"]) == pytest.approx((0.9, 0.9, 0.9))
    assert (row["us_per_decision_a"], row["us_per_decision_b"]) == (10.0, 9.0)


def test_an_interval_leaves_out_as_many_values_as_a_fair_coin_allows() -> None:
    # Of ten tosses at most one is heads in 11 of 1024 cases, at most two in 56; of six none in 1 of 64.
    assert compare.median_interval([3, 1, 2, 10, 9, 8, 4, 5, 6, 7]) == (2, 9)
    assert compare.median_interval([6, 5, 4, 3, 2, 1]) == (1, 6)
    assert compare.median_interval([2, 1, 3]) == (1, 3)
    assert compare.median_interval([5]) == (5, 5)


def test_an_interval_covers_the_true_ratio_at_least_nineteen_times_in_twenty() -> None:
    draw = np.random.default_rng(1)

    def covers(ratio: float) -> bool:
        first, second = np.exp(draw.normal(0, 0.1, (2, 20)))
        row = compare.compared("", first, ratio * second)
        return row["ratio_low"] <= ratio <= row["ratio_high"]

    # 95.9 % of 2000, give or take four standard errors.
    assert 0.94 <= np.mean([covers(1.3) for _ in range(2000)]) <= 0.978


def test_workloads_that_are_not_the_same_are_told() -> None:
    first, second = {"workload": {"num_envs": 256, "width": 32}}, {"workload": {"num_envs": 512, "width": 32}}
    assert compare.differing(first, first) == {}
    assert compare.differing(first, second) == {"num_envs": [256, 512]}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a", "b", "--rows", "colours"], "there is no row 'colours'"),
        (["a", "b", "--json", "no/such/folder/file.json"], "there is no folder"),
        (["a", "b", "--", "--num-envs", "7"], "train.num_envs"),
        (["slaw", "fast"], "there is no commit 'slaw'"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(
    words: Sequence[str], message: str, repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare.main(words, repository) == 2
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1


def test_each_commit_is_timed_by_its_own_worker_wherever_that_is(
    repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "compare.json"
    words = ["slow", "HEAD", "--repeats", "2", "--json", str(file), "--", *MINIATURE]
    assert compare.main(words, repository) == 0
    report = json.loads(file.read_text())
    rows = {row["name"]: row for row in report["rows"]}
    assert rows["acting"]["us_per_decision_a"] == 8.0 and rows["acting"]["us_per_decision_b"] == 4.0
    assert rows[WHOLE]["ratio"] == rows["acting"]["ratio"] == pytest.approx(0.5)
    assert report["workload"]["num_envs"] == 16 and report["differing"] == {}
    assert "| acting | 8.0 | 4.0 | 0.500 | 0.500 - 0.500 |" in capsys.readouterr().out
    assert len(git(repository, "worktree", "list").splitlines()) == 1


def test_options_of_b_alone_are_those_after_a_second_pair_of_dashes(
    repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "compare.json"
    words = ["slow", "slow", "--repeats", "1", "--json", str(file), "--", *MINIATURE, "--", "--env.sensor", "frames"]
    assert compare.main(words, repository) == 0
    report = json.loads(file.read_text())
    assert report["options"] == {"both": list(MINIATURE), "b": ["--env.sensor", "frames"]}
    assert report["differing"] == {"sensor": ["events", "frames"]}
    assert re.search(r"B is slow \(\w+\) with --env.sensor frames; a machine", capsys.readouterr().out)
    assert compare.main([*words[:-1], "eyes"], repository) == 2 and "eyes" in capsys.readouterr().err


def test_a_row_that_a_commit_does_not_have_is_told(repository: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert compare.main(["slow", "fast", "--rows", "acting", "sampling", "--", *MINIATURE], repository) == 2
    assert capsys.readouterr().err == "commit 'slow' has no row 'sampling'\n"


def test_a_commit_that_cannot_be_timed_is_told_with_its_reason(
    repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (repository / NEW).write_text("import no_such_thing")
    commit(repository, "broken")
    assert compare.main(["HEAD", "HEAD", "--rows", WHOLE, "--", *MINIATURE], repository) == 2
    assert "cannot be timed: ModuleNotFoundError: No module named 'no_such_thing'" in capsys.readouterr().err


@pytest.mark.slow
def test_this_commits_worker_describes_and_measures_the_wanted_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    class Whole:
        """Stands for the compiled chunk, which other tests compile."""

        def __init__(self, config: Any, world: Any, devices: Any) -> None:
            self.state = Trainer(config, world, devices).init(0)

        def turn(self) -> float:
            return 1000.0

    monkeypatch.setattr(worker, "WholeStep", Whole)
    words = ["--quick", "--", *MINIATURE]
    about, turns = worker.prepare([WHOLE, "acting", "colours"], words)
    assert about["rows"] == [WHOLE, "acting"] == list(turns)
    assert Path(about["package"]).parent == ROOT / "edqn_jax"
    assert about["workload"]["num_envs"] == 16 and about["device"] and about["versions"]
    assert turns[WHOLE]() == 1e6 * len(about["devices"]) / 1000.0
    assert turns["acting"]() > 0
    assert json.dumps(about)
