"""How long phases took the last time: kept, shown, and never in the way."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from edqn_jax.cli.process import durations, status
from edqn_jax.cli.process.durations import FILE, Durations, keep_durations, read_durations
from edqn_jax.cli.process.status import Status, last_time, show_phase


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of what is kept, which is not there yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "edqn_jax"


def test_phases_that_ended_are_kept_and_the_one_that_may_be_cut_short_is_not(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = iter((0.0, 0.0, 1.0, 13.5, 13.9, 60.0, 61.0, 62.0))
    monkeypatch.setattr(durations, "time", SimpleNamespace(monotonic=lambda: next(now)))
    one = Durations("edqn train")
    for name in ("starting", "compiling", "drawing", "training", "packing"):
        one.begin(name)
        one.begin(name)  # says how much of it is done
    one.keep()
    # Too short: drawing. As asked for: training. Not over: packing.
    assert read_durations() == {"edqn train: compiling": 12.5}
    assert Durations("edqn train").last("compiling") == 12.5 and Durations("edqn record").last("compiling") is None


def test_a_line_says_how_long_its_phase_took_the_last_time(folder: Path) -> None:
    keep_durations({"edqn check: drawing": 72.0, "edqn check: compiling": 3.0})
    shown = Status("edqn check", 2, lives=False, durations=Durations("edqn check"))
    shown.phase("drawing")
    assert shown.line(shown._phase_began + 1) == "edqn check: drawing, 0:01, last time 1:12"
    assert shown.line(shown._phase_began + 1, is_short=True) == "  drawing, 0:01"
    shown.phase("compiling", 1, 2)
    assert "last time" not in shown.line(shown._phase_began + 1)


def test_phases_are_timed_where_a_panel_shows_them_in_place_of_the_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep_durations({"edqn train: compiling": 8.0})
    timed = Durations("edqn train")
    monkeypatch.setattr(status, "_timed", [timed])
    show_phase("compiling")
    assert timed._name == "compiling" and last_time("compiling") == 8.0 and last_time("drawing") is None


@pytest.mark.parametrize("content", ["", "[]", '{"a": "b", "edqn x: y": 2}', "\ud800"])
def test_a_damaged_file_is_no_error_and_is_replaced(folder: Path, content: str) -> None:
    folder.mkdir()
    (folder / FILE).write_text(content, encoding="utf-8", errors="surrogatepass")
    assert set(read_durations()) <= {"edqn x: y"}
    keep_durations({"edqn train: compiling": 8.0})
    assert read_durations()["edqn train: compiling"] == 8.0


def test_only_the_newest_are_kept_and_nothing_where_nothing_can_be(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(durations, "MOST", 2)
    for name in "abca":
        keep_durations({name: 2.0})
    assert list(read_durations()) == ["c", "a"]
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    keep_durations({"d": 2.0})
    assert read_durations() == {}
