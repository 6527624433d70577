"""What a report says of the machine and the hour of its figures."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from measurement import conditions, json_report
from measurement.conditions import Watch, middle

BEFORE = "cpu  1000 0 500 8000 100 0 10 90 0 0\ncpu0 1 2 3\n"
AFTER = "cpu  1150 0 540 8080 110 0 20 100 77 0\ncpu0 1 2 3\n"
"""300 ticks later: 200 of them busy, 10 stolen."""


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(conditions, "PROC", tmp_path)
    monkeypatch.setattr(conditions, "CGROUP", tmp_path)
    return tmp_path


def test_what_others_take_is_told_from_what_is_stolen(system: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, own = iter([10.0, 12.0]), iter([5.0, 6.0])
    monkeypatch.setattr(conditions.time, "perf_counter", lambda: next(now))
    monkeypatch.setattr(conditions, "_own_seconds", lambda: next(own))
    monkeypatch.setattr(os, "sysconf", lambda name: {"SC_CLK_TCK": 100}[name])
    (system / "stat").write_text(BEFORE)
    (system / "cpu.stat").write_text("usage_usec 5\nthrottled_usec 1000000\n")
    watch = Watch()
    (system / "stat").write_text(AFTER)
    (system / "cpu.stat").write_text("usage_usec 9\nthrottled_usec 1500000\n")
    seen = watch.so_far()
    assert (seen["seconds"], seen["cores_busy"], seen["throttled_seconds"]) == (2.0, 0.5, 0.5)
    assert seen["cores_busy_with_others"] == pytest.approx(2.0 / 2 - 0.5)
    assert seen["steal"] == pytest.approx(10 / 300)


@pytest.mark.parametrize("stat", [None, "no numbers\n", "cpu  1 2 3\n"])
def test_a_system_that_tells_nothing_is_no_error(stat: str | None, system: Path) -> None:
    if stat is not None:
        (system / "stat").write_text(stat)
    seen = conditions.conditions(Watch())
    assert seen["steal"] is seen["cores_busy_with_others"] is seen["throttled_seconds"] is seen["quota_cores"] is None
    assert (seen["product_flops"] or 0) >= (seen["product_flops_median"] or 0) > 1e6
    assert "stolen" not in conditions.sentence(seen) and "Gflop/s" in conditions.sentence(seen)


@pytest.mark.parametrize(("said", "cores"), [("150000 100000\n", 1.5), ("max 100000\n", None)])
def test_the_quota_of_a_container_is_told(said: str, cores: float | None, system: Path) -> None:
    (system / "cpu.max").write_text(said)
    seen = conditions.conditions(Watch())
    assert seen["quota_cores"] == cores
    assert ("quota of 1.5 cores" in conditions.sentence(seen)) is (cores is not None)


def test_the_middle_of_several_turns_leaves_out_what_is_not_known() -> None:
    turns: list[dict[str, float | None]] = [{"seconds": 1.0, "steal": each, "load": None} for each in (0.1, None, 0.3)]
    assert middle(turns) == {"seconds": 3.0, "steal": pytest.approx(0.2), "load": None}


def test_every_report_has_processor_and_conditions_and_one_that_has_them_keeps_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "report.json"
    json_report.write(file, {"rows": []})
    first = json.loads(file.read_text())
    assert first["processor"] in capsys.readouterr().out and first["conditions"]["seconds"] > 0
    kept = first["conditions"] | {"load": 77.0}
    json_report.write(None, {"conditions": kept})
    assert "load 77.00" in capsys.readouterr().out
    json_report.write_row(file, {"conditions": kept})
    assert json.loads(file.read_text())["conditions"] == kept and not capsys.readouterr().out
