"""The page of a logged flight: what it says, and `edqn report` of a flight's folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from edqn_jax.cli import main
from edqn_jax.errors import ConfigError
from edqn_jax.fly.page import flight_page, happenings
from edqn_jax.fly.records import RECORDS, FlightLog, read_records
from tests.support.virtual_pilot import Camera, make


def flown(folder: Path, **more: float) -> Path:
    log = FlightLog(folder)
    pilot, wire = make(log=log, camera=Camera(**more))
    wire.said.append("<b>armed</b>")
    pilot.fly()
    log.close()
    return folder


def test_it_says_what_happened_when(tmp_path: Path) -> None:
    folder = flown(tmp_path / "flight", ends_at=52.5)
    records = read_records(folder)
    what = [word for _, word in happenings(records, records[1]["now"])]
    assert [each for each in what if "vehicle" not in each] == [
        "ready", "flying", "hovering", "holding", "ended", "outcome: no events",
    ]  # fmt: skip
    page = flight_page(folder)
    assert page.count("<svg") == 1 and "no events, " in page
    assert "vehicle: &lt;b&gt;armed" in page and "<b>" not in page


def test_report_of_a_flight_writes_its_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = flown(tmp_path / "flight")
    assert main(["report", str(folder)]) == 0
    assert (folder / "report.html").read_text().startswith("<!doctype html>")
    assert "open it in a browser" in capsys.readouterr().out
    assert main(["report", str(folder), "pretrained", "--out", str(tmp_path / "a.html")]) == 2
    assert "a page shows one flight, or runs" in capsys.readouterr().err


def test_a_flight_that_was_cut_off_has_a_page_and_one_that_did_not_begin_has_none(tmp_path: Path) -> None:
    folder = flown(tmp_path / "flight")
    lines = (folder / RECORDS).read_text().splitlines()
    (folder / RECORDS).write_text("\n".join(lines[: len(lines) // 2]) + "\n")
    assert "the log was cut off" in flight_page(folder)
    kept = [line for line in lines if json.loads(line)["kind"] != "tick"]
    (folder / RECORDS).write_text("\n".join(kept) + "\n")
    with pytest.raises(ConfigError, match="cut off before it began"):
        flight_page(folder)
