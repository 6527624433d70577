"""The benchmark of the wire: what it says of a short flight in real time, and bad input."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

pytest.importorskip("pymavlink")
pytest.importorskip("rotorpy")

import wire  # noqa: E402
from edqn_jax.errors import ConfigError  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore")  # jax2onnx, rotorpy and what they import


@pytest.mark.slow
def test_a_short_flight_in_real_time_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, before = tmp_path / "wire.json", wire.own_cores()
    words = ["--minutes", "0.04", "--seen", "0.5", "--camera", "64", "48", "--busy", "--json", str(file)]
    assert wire.main(words) == 0
    report = json.loads(file.read_text())
    rows = {row["name"]: row for row in report["rows"]}
    assert report["decisions"] >= 1 and report["seconds"] >= 2.4 and report["busy"] and report["logged"]
    assert report["events_per_second"] > 1000 and report["longest_gap_ms"] > 0.0
    assert rows["all"]["median_ms"] > rows["decide"]["median_ms"] > 0.0 and rows["age"]["median_ms"] > 0.0
    assert "between setpoints" in capsys.readouterr().out
    assert wire.own_cores() == before


def test_bad_input_is_one_sentence(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert wire.main(["--minutes", "0"]) == 2
    assert capsys.readouterr().err.startswith("--minutes, --seen and --pace must be above 0")
    monkeypatch.delattr(os, "sched_setscheduler", raising=False)
    with pytest.raises(ConfigError, match="--first cannot be had"):
        wire.come_first()
    monkeypatch.setattr(wire, "own_cores", lambda: [0])
    assert wire.main([]) == 2
    assert "need a core beside the pilot's" in capsys.readouterr().err
