"""Phases of a call from Python: shown on a terminal, told to whoever asks, and nowhere else."""

from __future__ import annotations

import io
import sys
from typing import Any

import pytest

import edqn_jax
from edqn_jax.watchers import shown_phases, taken
from tests.support.miniature import WORLD


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


def test_no_second_line_is_shown_where_a_command_or_script_shows_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Stream(terminal=True)
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    with taken("my script"), shown_phases(None) as told:
        assert told is None
    with shown_phases(None) as told:
        assert told is not None
    assert stream.getvalue()


def test_what_is_printed_meanwhile_to_a_file_stays_there(monkeypatch: pytest.MonkeyPatch) -> None:
    file = Stream(terminal=False)
    monkeypatch.setattr(sys, "stderr", Stream(terminal=True))
    monkeypatch.setattr(sys, "stdout", file)
    monkeypatch.setenv("TERM", "xterm")
    with shown_phases(None):
        print("a note")
    assert file.getvalue() == "a note\n"


def test_an_evaluation_tells_its_phases_to_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Stream(terminal=True)
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    config = edqn_jax.make_config(str(WORLD), drone={"physics": "rigid_body"}, env={"sensor": "blind"})
    policy = edqn_jax.FunctionPolicy(lambda observation, memory, key: ("up", memory), config)
    edqn_jax.evaluate(policy, str(WORLD))
    assert all(f"{name} " in stream.getvalue() for name in ("preparing worlds", "compiling", "shortest paths"))


@pytest.mark.parametrize("terminal", [True, False])
def test_an_environment_tells_a_terminal_alone_that_worlds_are_prepared(
    monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    stream = Stream(terminal=terminal)
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    edqn_jax.make(str(WORLD), edqn_jax.make_config(str(WORLD), drone={"physics": "rigid_body"}))
    assert ("preparing worlds" in stream.getvalue()) == bool(stream.getvalue()) == terminal
