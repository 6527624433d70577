"""What a command shows of itself while it works: a line that ticks on a terminal, one now and then elsewhere."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest

from edqn_jax.cli.process import status as statuses
from edqn_jax.cli.process.status import SILENT_S, Status, end_status, say_phase, show_phase
from tests.support.processes import PATIENCE_S

ROOT = Path(__file__).parents[2]

WORKS = """
import sys
from edqn_jax.cli.process.status import show_phase, shown_status
from edqn_jax.cli.process.streams import lasting_streams

with lasting_streams() as outputs, shown_status(sys.argv[1:], outputs):
    print("heavy" if {"jax", "tyro", "numpy", "rich"} & set(sys.modules) else "light")
    show_phase("flying", 1, 4)
    while sys.stdin.readline() == "wait\\n":
        pass
    print("done")
"""


def read_until(reads: int, end: bytes, said: bytes = b"") -> bytes:
    """Returns what is written to a descriptor until `end` is in it."""
    while end not in said:
        more = os.read(reads, 1024)
        assert more, said
        said += more
    return said


@pytest.fixture
def written() -> tuple[int, int]:
    """A pipe: what is read and what is written."""
    return os.pipe()


def test_a_line_names_phase_clock_and_what_is_left() -> None:
    status = Status("edqn record", 2, lives=False)
    began = status._began
    assert status.line(began + 3.0) == "edqn record: starting, 0:03"
    status.phase("drawing")
    status._phase_began = began + 60.0
    assert status.line(began + 62.0) == "edqn record: drawing, 0:02, 1:02 in all"
    status.phase("drawing", 20, 80)
    assert status.line(began + 80.0) == "edqn record: drawing, 20 of 80, 0:20, about 1:00 left, 1:20 in all"
    status.phase("drawing", 80, 80)
    assert "left" not in status.line(began + 90.0)
    # Of flights that are flown at once most end late: nothing is known of the time that is left.
    status.phase("flying the missions", 3, 300)
    status._phase_began = began + 90.0
    assert status.line(began + 95.0) == "edqn record: flying the missions, 3 of 300, 0:05, 1:35 in all"


def test_a_terminal_sees_a_line_before_anything_is_imported_that_makes_way_and_is_gone_at_the_end() -> None:
    reads, terminal = pty.openpty()
    environ = {**os.environ, "PYTHONPATH": str(ROOT), "TERM": "xterm", "COLUMNS": "100"}
    words = [sys.executable, "-c", WORKS, "evaluate", "pretrained"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=terminal, stderr=terminal, env=environ) as process:
        os.close(terminal)
        assert process.stdin is not None
        said = read_until(reads, b"flying, 1 of 4", read_until(reads, b"light\r\n"))
        # The clock goes on while the command is silent.
        said = read_until(reads, b"0:01", said)
        process.stdin.close()
        said = read_until(reads, b"done\r\n", said)
        assert process.wait(PATIENCE_S) == 0
    os.close(reads)
    assert said.startswith(b"\r\x1b[Kedqn evaluate: starting, 0:00\r\x1b[Klight")
    assert said.endswith(b"\r\x1b[Kdone\r\n")


def shown_in_a_pipe(*argv: str) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-c", WORKS, *argv]
    return subprocess.run(words, input="", capture_output=True, text=True, cwd=ROOT, timeout=PATIENCE_S)


def test_a_pipe_sees_the_first_line_at_once_and_its_output_is_the_commands_own() -> None:
    ended = shown_in_a_pipe("--import", "own.py", "evaluate", "pretrained")
    # On a machine that is slower than two seconds, lines follow.
    assert re.fullmatch(r"edqn evaluate: starting, 0:0\d\n( .*\n)*", ended.stderr) and ended.stdout == "light\ndone\n"


@pytest.mark.parametrize(
    "argv",
    [[], ["--version"], ["train", "--help"], ["completion", "bash"], ["fly", "p.onnx", "--clock", "127.0.0.1:1"]],
)
def test_what_is_there_at_once_has_no_line_in_a_pipe(argv: list[str]) -> None:
    assert shown_in_a_pipe(*argv).stderr == ""


def test_a_pipe_gets_a_line_after_each_long_silence(written: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    reads, writes = written
    monkeypatch.setattr(statuses, "TICK_S", 0.01)
    status = Status("edqn train", writes, lives=False)
    status.start()
    status.phase("compiling")
    assert read_until(reads, b"\n") == b"edqn train: starting, 0:00\n"
    # The first line of a phase has the command's name and clock; those after it are short.
    for begins in (b"edqn train: compiling, 0:0", b"  compiling, 0:0", b"  compiling, 0:0"):
        status._printed -= SILENT_S
        assert read_until(reads, b"\n").startswith(begins)
    status.phase("flying", 3, 4)
    status._printed -= SILENT_S
    assert read_until(reads, b"\n").startswith(b"edqn train: flying, 3 of 4, 0:0")
    status.stop()


def test_a_pipe_is_never_silent_for_three_seconds() -> None:
    assert SILENT_S + 2 * statuses.TICK_S <= 3.0


def test_a_line_never_ends_what_somebody_else_has_begun(
    written: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    reads, writes = written
    status = Status("edqn train", writes, lives=True)
    status._show()
    status.make_way(b"half a line", is_terminal=True)
    monkeypatch.setattr(status, "_show", lambda: pytest.fail("the line would be cut"))
    ends = iter((False, False, True))
    monkeypatch.setattr(status._ended, "wait", lambda _: next(ends))
    status._tick()
    os.close(writes)
    assert os.read(reads, 1024).endswith(b"\r\x1b[K")


def test_outside_of_a_command_nothing_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    show_phase("flying", 1, 2)
    end_status()
    assert capsys.readouterr() == ("", "")
    say_phase("flying 3 missions")
    assert capsys.readouterr() == ("flying 3 missions\n", "")


SCRIPT = """
import edqn_jax
show_phase = edqn_jax.show_phases("mine")
import sys
print("heavy" if {"jax", "numpy"} & set(sys.modules) else "light", flush=True)
show_phase("learning", 1, 4)
sys.stdin.readline()
print("learnt")
"""


def test_a_script_shows_its_phases_until_it_ends() -> None:
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", SCRIPT], cwd=ROOT, stdin=pipe, stdout=pipe, stderr=pipe) as script:
        assert script.stderr is not None
        said = read_until(script.stderr.fileno(), b"left\n")
        ended = script.communicate(b"go on\n", timeout=PATIENCE_S)
    assert re.match(rb"mine: starting, 0:0\d\n(.*\n)*mine: learning, 1 of 4, 0:0\d, about 0:\d\d left\n", said)
    assert (ended[0], script.returncode) == (b"light\nlearnt\n", 0)
