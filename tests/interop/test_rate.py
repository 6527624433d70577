"""The benchmark of Gymnasium's environments: what it says, and bad input."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import interop


def test_it_measures_what_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "interop.json"
    words = ["--num-envs", "2", "--steps", "3", "--repeats", "1", "--json", str(file)]
    flags = ["--env.sensor", "ranges", "--camera.width", "16", "--camera.height", "12"]
    assert interop.main([*words, "--", *flags]) == 0
    report = json.loads(file.read_text())
    assert [row["name"] for row in report["rows"]] == ["pure functions", "DroneVectorEnv", "DroneEnv"]
    rates = [row["decisions_per_second"] for row in report["rows"]]
    assert report["share_of_pure_functions"] == pytest.approx(rates[1] / rates[0])
    assert "of the pure functions' decisions" in capsys.readouterr().out


def test_bad_input_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert interop.main(["--", "--agent.batch-size", "0"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    with pytest.raises(SystemExit):
        interop.main(["--num-envs", "0"])
    assert "argument --num-envs: must be a whole number of at least 1, not 0" in capsys.readouterr().err
