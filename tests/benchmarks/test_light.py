"""Rows of light: each policy flies the same missions in every light."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import light
import success
from tests.support.benchmarks.untrained_runs import SMALL, untrained


def call(out: Path, *words: str) -> int:
    arguments = ["--out", str(out), "--world", "sparse", "--sensors", "frame-pair", "--speeds", "6"]
    return light.main([*arguments, "--lux", "1", "100", "--seeds", "2", "--missions", "3", *words, "--", *SMALL])


@pytest.mark.slow
def test_a_row_flies_each_policy_in_each_light(tmp_path: Path, monkeypatch, capsys) -> None:
    flown = []
    turns_of = success.turns_of
    monkeypatch.setattr(light, "use_cpu_devices", lambda count: None)
    monkeypatch.setattr(success, "train_seeds", untrained)
    monkeypatch.setattr(success, "turns_of", lambda *given: flown.append(given) or turns_of(*given))
    assert call(tmp_path) == 0
    shown = capsys.readouterr().out
    (file,) = tmp_path.glob("sparse-frame-pair-*.json")
    row = json.loads(file.read_text())
    assert [each["lux"] for each in row["lights"]] == [1, 100] and row["speed_m_s"] == 6
    assert all([turn["seed"] for turn in each["turns"]] == [0, 1] for each in row["lights"])
    # First in the light that was trained in, then in each alone: the same worlds, sensor and speed.
    lights = [(config.light.least_lux, config.light.most_lux) for config, *_ in flown]
    assert lights == [(1, 100), (1, 1), (100, 100)]
    assert all(config.exposure.real and config.env.speed_m_s == 6 for config, *_ in flown)
    assert "| drawn light | 1 lux | 100 lux |" in shown and "| sparse | 6 | frame-pair | 0.0% (0.0 to " in shown
    assert call(tmp_path, "--report") == 0 and capsys.readouterr().out == shown


def test_each_sensor_has_the_faults_of_a_real_one() -> None:
    args = light.parse(["--out", "x", "--", *SMALL])
    events = light.config_of(args, "events", 4.0)
    assert events.events.bandwidth_hz == 30 and events.events.threshold == 0.03 and events.light.most_lux == 10_000
    assert light.config_of(args, "frames", 8.0).exposure.real


def test_lights_from_bright_to_dark_are_refused(capsys) -> None:
    with pytest.raises(SystemExit):
        light.parse(["--out", "x", "--lux", "10", "1"])
    assert "--lux must go from dark to bright" in capsys.readouterr().err
