"""Training on more and more cores: which ones, with what workload, and what is made of the turns."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import scaling
from curves import cores
from curves.cores import Plan, choose_cpus, measure_rows, physical_cores, summary, with_cores
from edqn_jax.errors import ConfigError
from measurement.flags import parse_config

BASE = parse_config([])

STANDS_FOR_TRAINING = """
import json, sys, time
from measurement.child import answers
spec = json.loads(sys.argv[1])
many = len(spec["cpus"])
stream = answers()
if many == 2 and "crash" in sys.argv: sys.exit("no memory for two")
if many == 2 and "hang" in sys.argv: time.sleep(60)
say = lambda x: print(json.dumps(x), file=stream)
say({"workload": {"physics_steps_per_decision": 10}, "compile_seconds": 3.0})
seen = {"seconds": 1.0, "load": 0.5, "cores_busy": many, "cores_busy_with_others": None, "steal": None}
told = {"step": [100.0 * many**0.5, seen], "rollout": 4000.0 * many, "rates": {"product_flops": 1e9}}
for line in sys.stdin:
    say(told[line.strip()])
"""


@pytest.fixture(autouse=True)
def two_cpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "row.py"
    script.write_text(STANDS_FOR_TRAINING)
    monkeypatch.setattr(cores, "SCRIPT", script)
    monkeypatch.setattr(cores.os, "sched_getaffinity", lambda _: {4, 6})


def test_each_core_gets_the_same_work() -> None:
    for count in (1, 2, 3, 12, 16, 32):
        config = with_cores(BASE, count, 64)
        agent, train = config.agent, config.train
        assert (train.num_envs, train.devices) == (64 * count, count) and train.shards % count == 0
        assert agent.updates_per_step * agent.batch_size == 4 * train.num_envs
        assert agent.replay_size == BASE.agent.replay_size * count // 4 and config.encoder.batch_size == train.num_envs


def test_cores_come_before_their_second_threads_and_one_package_before_the_other(tmp_path: Path) -> None:
    # Two packages of two cores of two threads, numbered as Linux does: second threads last.
    for cpu in range(8):
        folder = tmp_path / f"cpu{cpu}" / "topology"
        folder.mkdir(parents=True)
        (folder / "physical_package_id").write_text(f"{cpu % 2}\n")
        (folder / "core_id").write_text(f"{cpu // 2 % 2}\n")
    assert choose_cpus(4, range(8), tmp_path) == [0, 2, 1, 3]
    assert choose_cpus(6, range(8), tmp_path) == [0, 2, 1, 3, 4, 6]
    assert physical_cores([0, 2, 4], tmp_path) == 2 and physical_cores([0, 2, 4], tmp_path / "none") == 3
    with pytest.raises(ConfigError, match="--cores must be at most 8"):
        choose_cpus(9, range(8), tmp_path)


def test_ratios_are_those_of_turns() -> None:
    turns = {
        **{"step": [100.0, 10.0, 100.0], "rollout": [2000.0, 200.0, 1000.0]},
        **{"first_step": [50.0, 5.0, 10.0], "first_rollout": [1000.0, 100.0, 100.0]},
    }
    row = summary(turns, 13)
    assert row["decisions_per_second"] == 100.0 and row["decisions_low"] == 10.0
    assert row["over_c_mujoco_rollout"] == pytest.approx(0.65)  # the slow turn was slow for both
    assert (row["over_first"], row["c_mujoco_over_first"]) == (2.0, 2.0)


def test_rows_come_as_they_end_in_turns_with_the_first(tmp_path: Path) -> None:
    rows = list(measure_rows(Plan((2, 1), (8, 16), 2, 60), tmp_path))
    assert [(row["cores"], row["cpus"], row["environments_per_core"]) for row in rows] == [
        (count, [4, 6][:count], environments) for environments in (8, 16) for count in (1, 2)
    ]
    assert rows[0]["over_c_mujoco_rollout"] == pytest.approx(0.25) and rows[0]["over_first"] == 1.0
    assert rows[1]["over_first"] == pytest.approx(2**0.5) and rows[1]["c_mujoco_over_first"] == 2.0
    assert rows[1]["turns"]["first_step"] == [100.0, 100.0] and rows[1]["conditions"]["seconds"] == 2.0


@pytest.mark.parametrize(("flag", "says"), [("crash", "no memory for two"), ("hang", "took more than 2 s")])
def test_a_row_that_fails_says_why_and_the_others_are_measured(flag: str, says: str, tmp_path: Path) -> None:
    rows = list(measure_rows(Plan((1, 2), (8,), 1, 2, (flag,)), tmp_path))
    assert [row.get("error") for row in rows] == [None, says]
    assert f"| 2 | 8 | {says} |" in cores.line(rows[1]) and cores.line(rows[1]).count("|") == cores.line(rows[0]).count(
        "|"
    )


def test_the_command_prints_rows_and_appends_them_to_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scaling, "keep_to_cpu", lambda: None)
    monkeypatch.setattr(scaling, "use_cpu_devices", lambda: None)
    lines, report = tmp_path / "cores.jsonl", tmp_path / "cores.json"
    words = ["--cores", "1", "2", "--environments", "8", "--repeats", "1"]
    assert scaling.main([*words, "--lines", str(lines), "--json", str(report)]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(cores.HEAD) and "| 2 | 8 | 141 | 1.41 | 8,000 | 2.00 | 0.177 |" in shown
    assert [json.loads(line)["cores"] for line in lines.read_text().splitlines()] == [1, 2]
    assert [row["cores"] for row in json.loads(report.read_text())["rows"]] == [1, 2]


def test_what_cannot_be_trained_is_told_before_anything_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scaling, "keep_to_cpu", lambda: None)
    with pytest.raises(ConfigError, match="train.num_envs"):
        scaling.parse(["--cores", "1", "--environments", "7"])
    with pytest.raises(ConfigError, match="there is no folder"):
        scaling.parse(["--cores", "1", "--lines", "no/such/folder/cores.jsonl"])
