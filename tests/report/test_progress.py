"""What a person sees while a drone learns."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from edqn_jax.report.progress import Progress, clock


def shown(terminal: bool, every_s: float) -> str:
    out = io.StringIO()
    progress = Progress(Console(file=out, force_terminal=terminal, width=120), every_s)
    progress.start(1000)
    for decisions in (100, 200, 300):
        progress.update({"phase": "learning", "decisions": decisions, "success_rate": 0.25, "q_loss": None})
    progress.message("flown: [goal]")
    progress.stop()
    return out.getvalue()


def test_without_a_terminal_there_are_plain_lines():
    lines = shown(terminal=False, every_s=0.0).splitlines()
    assert len(lines) == 4
    assert "learning 300 (30%)  success 25.0%" in lines[2]
    assert "\x1b" not in "".join(lines)


def test_lines_keep_their_distance_in_time():
    assert len(shown(terminal=False, every_s=1000.0).splitlines()) == 2


def test_a_terminal_shows_the_last_values_and_keeps_messages():
    out = shown(terminal=True, every_s=0.0)
    assert "300 / 1,000" in out and "25.0%" in out and "flown: [goal]" in out


def test_stopping_what_never_started_is_harmless():
    Progress(Console(file=io.StringIO())).stop()


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0:00"), (75, "1:15"), (3675, "1:01:15")])
def test_clock_reads_like_one(seconds, text):
    assert clock(seconds) == text
