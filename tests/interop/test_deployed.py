"""The benchmark of an exported policy: what it says, and bad input."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import deployed
from tests.support.benchmarks.kept_cores import give_cores

pytestmark = pytest.mark.filterwarnings("ignore")  # jax2onnx and what it imports


def test_it_keeps_to_one_core_and_says_what_it_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kept_to = give_cores(monkeypatch, 2, 3)
    file = tmp_path / "deployed.json"
    assert deployed.main(["--quick", "--camera", "64", "48", "--json", str(file)]) == 0
    assert kept_to == [{2}]
    report = json.loads(file.read_text())
    (row,) = report["rows"]
    assert report["camera"] == [64, 48] and report["decisions"] == 200 and report["events_per_packet"] > 100
    assert 0.0 < row["median_ms"] <= row["p99_ms"]
    assert "of 64 x 48 pixels to the command" in capsys.readouterr().out


def test_bad_input_is_one_sentence(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    give_cores(monkeypatch, 0)
    assert deployed.main(["nowhere"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert deployed.main(["--camera", "0", "4"]) == 2
    assert "--camera must be two numbers of at least 1" in capsys.readouterr().err
