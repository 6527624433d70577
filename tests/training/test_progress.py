"""The progress display of a run."""

from __future__ import annotations

import io
import sys
import threading
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from edqn_jax.errors import ConfigError
from edqn_jax.training import progress as module
from edqn_jax.training.loop import train, train_seeds
from edqn_jax.training.progress import Progress, format_duration, shown_progress
from edqn_jax.watchers import has_panel
from tests.support.configs import BLIND_RUN
from tests.support.processes import PATIENCE_S


def shown(terminal: bool, every_s: float) -> str:
    out = io.StringIO()
    progress = Progress(Console(file=out, force_terminal=terminal, width=120), every_s)
    progress.phase("compiling")
    progress.phase("training", total=1000)
    for decisions in (100, 200, 300):
        progress.update({"phase": "training", "decisions": decisions, "success_rate": 0.25, "q_loss": None})
        progress.phase("validating")
        progress.phase("training")
    progress.message("flown: [goal]")
    progress.stop()
    return out.getvalue()


def test_without_a_terminal_there_are_plain_lines():
    lines = shown(terminal=False, every_s=0.0).splitlines()
    assert lines[:2] == ["[0:00] compiling", "[0:00] training"]
    assert [line.split()[1] for line in lines[2:-1]] == ["training", "validating"] * 3
    assert "training 300 (30%)  success 25.0%" in lines[6]
    assert "\x1b" not in "".join(lines)


def test_lines_of_metrics_keep_their_distance_in_time():
    assert sum("(" in line for line in shown(terminal=False, every_s=1000.0).splitlines()) == 1


def test_a_terminal_shows_the_last_values_and_keeps_messages():
    out = shown(terminal=True, every_s=0.0)
    assert "300 / 1,000" in out and "25.0%" in out and "flown: [goal]" in out and "in all" in out


def test_missions_are_counted_while_they_fly_and_only_then():
    told: list[tuple[object, ...]] = []
    console = Console(file=io.StringIO(), force_terminal=True, width=120)
    progress = Progress(console, tell=lambda *words: told.append(words))

    def seen() -> str:
        with console.capture() as panel:
            console.print(progress._panel())
        return panel.get()

    progress.phase("training", total=1000)
    progress.phase("validating")
    progress.count(1, 300)
    assert "validating, 1 of 300, 0:00" in seen()
    progress.phase("training")
    assert "300" not in seen()
    progress.stop()
    assert told == [("training",), ("validating",), ("validating", 1, 300), ("training",)]


def test_a_loss_that_a_chunk_does_not_have_is_not_shown_again():
    out = io.StringIO()
    progress = Progress(Console(file=out), every_s=0.0)
    progress.phase("training", total=1000)
    progress.update({"decisions": 100, "kl": 3.0, "validation_success": 0.5})
    progress.update({"decisions": 200, "kl": None})
    first, second = out.getvalue().splitlines()[1:]
    assert "KL 3" in first and "KL" not in second
    assert "validation 50.0%" in second


@pytest.mark.parametrize("terminal", [False, True])
def test_what_a_learner_of_ones_own_tells_is_shown_by_its_name(terminal: bool) -> None:
    out = io.StringIO()
    progress = Progress(Console(file=out, force_terminal=terminal, width=160), every_s=0.0)
    progress.phase("training", total=1000)
    many = {f"number_{i}": i for i in range(9)}
    progress.update(
        {"phase": "training", "decisions": 100, "diverged": 7, "warm_up": {"kl": [1.0]}, "validation_spl": 0.5}
        | {"soft_temperature": 0.125, "q_loss": None, "words": "none"}
        | many
    )
    progress.stop()
    text = out.getvalue()
    assert "soft temperature" in text and "0.125" in text and "number 4" in text and "number 5" not in text
    assert not any(word in text for word in ("Q loss", "diverged", "spl", "warm", "words"))


def test_the_estimate_is_made_of_training_alone(monkeypatch):
    """A warm-up at 1 decision a second and a retraining at 2 do not count: 600 decisions left at 10 a second."""
    now, out = [0.0], io.StringIO()
    monkeypatch.setattr("edqn_jax.training.progress.time.monotonic", lambda: now[0])
    progress = Progress(Console(file=out, width=200), every_s=0.0)
    progress.phase("training", total=1000)
    for seconds, decisions, phase in ((100, 100, "warm-up"), (110, 200, "training"), (160, 300, "retraining")):
        now[0] = seconds
        progress.update({"phase": phase, "decisions": decisions})
    now[0] = 170.0
    progress.update({"phase": "training", "decisions": 400})
    warm_up, training, retraining, last = (line.split("training left ")[1] for line in out.getvalue().splitlines()[1:])
    assert (warm_up, training, retraining, last) == ("–", "1:20", "1:10", "1:00")


def test_the_estimate_follows_a_machine_that_becomes_slower(monkeypatch):
    """600 decisions at 10 a second, then at 1: after some minutes the 100 that are left take nearly 100 s."""
    now, out = [0.0], io.StringIO()
    monkeypatch.setattr("edqn_jax.training.progress.time.monotonic", lambda: now[0])
    progress = Progress(Console(file=out, width=200), every_s=0.0, began=-20.0)
    progress.phase("training", total=1000)
    for decisions in (*range(10, 610, 10), *range(610, 910, 10)):
        now[0] += 1.0 if decisions <= 600 else 10.0
        progress.update({"phase": "training", "decisions": decisions})
    line = out.getvalue().splitlines()[-1]
    minutes, seconds = line.split("training left ")[1].split(":")
    assert 85 <= 60 * int(minutes) + int(seconds) <= 100
    assert line.startswith("[6:20]")  # 360 s, and the 20 before


def test_the_estimate_does_not_jump_after_a_validation(monkeypatch):
    """Ten decisions a second, and a validation of 60 s after each 300: a fifth of the time is validating."""
    now, out = [0.0], io.StringIO()
    monkeypatch.setattr("edqn_jax.training.progress.time.monotonic", lambda: now[0])
    progress = Progress(Console(file=out, width=200), every_s=0.0)
    progress.phase("training", total=30_000)
    estimates = []
    for decisions in range(50, 12_050, 50):
        now[0] += 5.0
        progress.update({"phase": "training", "decisions": decisions})
        minutes, seconds = out.getvalue().splitlines()[-1].split("training left ")[1].split(":")
        estimates.append(60 * int(minutes) + int(seconds))
        if decisions % 3000 == 0:
            progress.phase("validating")
            now[0] += 60.0
            progress.phase("training")
    after = np.array(estimates[60:])  # the first validation is over
    changes = np.diff(after)
    assert np.all((changes <= 70) & (changes >= -20))
    assert after[-1] == pytest.approx((30_000 - 12_000) / 10 * 1.2, rel=0.06)


def test_stopping_what_never_started_is_harmless():
    Progress(Console(file=io.StringIO())).stop()


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0:00"), (75, "1:15"), (3675, "1:01:15")])
def test_clock_reads_like_one(seconds, text):
    assert format_duration(seconds) == text


def test_a_dumb_terminal_has_lines_and_no_panel(monkeypatch: pytest.MonkeyPatch) -> None:
    """It shows a panel only once that has ended."""
    monkeypatch.setenv("TERM", "dumb")
    assert not has_panel(Console(force_terminal=True))
    assert shown(terminal=True, every_s=0.0).splitlines()[0] == "[0:00] compiling"


def test_below_a_cell_one_panel_is_drawn_anew_and_its_last_state_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock goes on while the host waits, and the output is text, small enough to be kept in a notebook."""
    states: list[str] = []
    ticked = threading.Event()

    def update(data: dict[str, str], *, raw: bool) -> None:
        assert raw and list(data) == ["text/plain"]
        states.append(data["text/plain"])
        if len(states) > 3:
            ticked.set()

    def display(data: dict[str, str], *, raw: bool, display_id: bool) -> Any:
        assert display_id
        update(data, raw=raw)
        return SimpleNamespace(update=update)

    ipython: Any = ModuleType("IPython.display")
    ipython.display = display
    monkeypatch.setitem(sys.modules, "IPython", ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", ipython)
    monkeypatch.setattr(module, "CELL_EVERY_S", 0.01)
    progress = Progress(Console(force_jupyter=True))
    progress.phase("preparing worlds")
    assert ticked.wait(PATIENCE_S)
    progress.phase("training", total=1000)
    progress.update({"phase": "training", "decisions": 300, "success_rate": 0.25})
    progress.stop()
    assert "preparing worlds" in states[0] and "300 / 1,000" in states[-1] and "25.0%" in states[-1]
    assert "\x1b" not in states[-1] and max(map(len, states[-1].splitlines())) == module.CELL_COLUMNS
    assert not any(thread.name == "cell panel" for thread in threading.enumerate())


@pytest.mark.parametrize("is_terminal", [False, True])
def test_python_shows_a_training_on_a_terminal_unless_told_otherwise(
    is_terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Stream(io.StringIO):
        def isatty(self) -> bool:
            return is_terminal

    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("FORCE_COLOR", "1")  # says nothing of a terminal

    def said(progress: bool | None) -> str:
        monkeypatch.setattr(sys, "stderr", Stream())
        with shown_progress(progress) as display:
            assert (display is not None) == (progress or (progress is None and is_terminal))
            if display is not None:
                display.phase("compiling")
        return sys.stderr.getvalue()  # pyright: ignore[reportAttributeAccessIssue]

    assert said(False) == ""
    assert ("compiling" in said(None)) == is_terminal
    assert "compiling" in said(True)


@pytest.mark.parametrize("call", [train, lambda config, **given: train_seeds(2, config, **given)])
def test_training_in_python_tells_its_phases(
    call: Callable[..., object], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*_: object) -> None:
        raise ConfigError("far enough")

    monkeypatch.setattr("edqn_jax.training.setup.missions_of_runs", stopped)
    for progress, said in ((True, "[0:00] preparing worlds\n"), (False, ""), (None, "")):
        with pytest.raises(ConfigError, match="far enough"):
            call(BLIND_RUN, progress=progress)
        assert capsys.readouterr() == ("", said)
