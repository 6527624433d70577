"""The benchmark of one decision: what it says, and that it keeps to one core."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import decision
from tests.support.benchmarks.kept_cores import give_cores


@pytest.mark.slow
def test_it_keeps_to_one_core_and_says_what_it_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kept_to = give_cores(monkeypatch, 2, 3)
    monkeypatch.setattr(decision, "decision_latency_ms", lambda *_: {"median": 0.5, "p99": 0.75})
    file = tmp_path / "decision.json"
    assert decision.main(["--quick", "--json", str(file)]) == 0
    assert kept_to == [{2}]
    assert "median 0.50 ms, 99th percentile 0.75 ms (200 decisions" in capsys.readouterr().out
    report = json.loads(file.read_text())
    assert report["rows"] == [{"name": "one_decision", "median_ms": 0.5, "p99_ms": 0.75}]
    assert report["cores"] == 1 and report["versions"]["jax"]


def test_bad_input_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert decision.main(["--", "--agent.batch-size", "0"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
