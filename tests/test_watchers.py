"""Phases of a call from Python: shown on a terminal, told to whoever asks, and nowhere else."""

from __future__ import annotations

import io
import sys
from typing import Any

import pytest

from edqn_jax.watchers import shown_phases


class Stream(io.StringIO):
    def __init__(self, *, terminal: bool) -> None:
        super().__init__()
        self.terminal = terminal

    def isatty(self) -> bool:
        return self.terminal


@pytest.mark.parametrize("terminal", [True, False])
def test_a_terminal_shows_phases_and_how_many_are_done(monkeypatch: pytest.MonkeyPatch, terminal: bool) -> None:
    stream = Stream(terminal=terminal)
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    with shown_phases(None) as told:
        assert (told is not None) == terminal
        if told is not None:
            told("compiling")
            told("flying the missions", 3, 1200)
    shown = stream.getvalue()
    assert ("flying the missions 3 of 1,200" in shown) == terminal and bool(shown) == terminal
    assert not shown or "\x1b[2K" in shown.rpartition("flying the missions")[2]  # the line is gone


def test_who_gives_a_phase_is_told_and_nothing_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    stream, heard = Stream(terminal=True), []

    def hear(*said: Any) -> None:
        heard.append(said)

    monkeypatch.setattr(sys, "stderr", stream)
    with shown_phases(hear) as told:
        assert told is hear
    assert stream.getvalue() == ""
