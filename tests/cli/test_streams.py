"""What cannot be written to a command's streams is replaced or dropped, and the command goes on."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from edqn_jax.cli.process.streams import Lasting, lasting_streams
from tests.support.marks import in_whole
from tests.support.processes import PATIENCE_S

ROOT = Path(__file__).parents[2]

LIVE = """
import sys, time
from rich.console import Console
from edqn_jax.cli.process.streams import lasting_streams
from edqn_jax.training.progress import Progress
with lasting_streams():
    progress = Progress(Console(force_terminal=True))
    progress.phase("training", total=100)
    for number in range(8):
        time.sleep(0.1)
        progress.update({"decisions": number, "epsilon": 0.5})
    progress.stop()
    print("done", file=sys.stderr)
"""
"""A live panel, drawn by a thread of its own, which goes on when nobody reads."""


def test_a_reader_that_is_gone_ends_nothing_and_is_noticed_once() -> None:
    reads, writes = os.pipe()
    output = Lasting(writes)
    assert output.write(b"one") == 3 and os.read(reads, 9) == b"one"
    os.close(reads)
    assert output.write(b"three") == 5 and output.write(b"to none") == 7
    assert output.failure is not None and output.failure.errno == errno.EPIPE
    os.close(writes)


def test_a_pipe_that_is_full_and_does_not_block_is_waited_for() -> None:
    reads, writes = os.pipe()
    os.set_blocking(writes, False)
    content = bytes(200_000)  # more than a pipe holds
    read = bytearray()

    def reader() -> None:
        time.sleep(0.1)
        while len(read) < len(content):
            read.extend(os.read(reads, 65_536))

    thread = threading.Thread(target=reader)
    thread.start()
    with io.BufferedWriter(Lasting(writes)) as output:
        output.write(content)
    thread.join(PATIENCE_S)
    assert bytes(read) == content
    os.close(reads)
    os.close(writes)


def test_streams_of_somebody_else_are_left_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = io.StringIO()
    monkeypatch.setattr(sys, "stdout", notebook)
    with lasting_streams():
        assert sys.stdout is notebook
        print("shown")
    assert notebook.getvalue() == "shown\n"


@pytest.mark.parametrize("streams", ["2>&1 >&- | true", *in_whole("", ">&-", "2>&-", "<&- >&- 2>&-", "| true")])
def test_a_live_panel_goes_on_whoever_reads(streams: str, tmp_path: Path) -> None:
    done = tmp_path / "done"
    script = f'{{ "$PYTHON" -c "$1" {streams}; }} 2>/dev/null; echo "${{PIPESTATUS[0]}}" > "$2"'
    words = ["/bin/bash", "-c", f"set -o pipefail; {script}", "bash", LIVE, str(done)]
    environ = {**os.environ, "PYTHON": sys.executable, "PYTHONPATH": str(ROOT)}
    ended = subprocess.run(words, env=environ, capture_output=True, timeout=PATIENCE_S)
    assert b"Traceback" not in ended.stderr and done.read_text() == "0\n"


def test_no_file_gets_the_number_of_a_closed_stream(tmp_path: Path) -> None:
    opens = (
        "import sys\nfrom edqn_jax.cli.process.streams import lasting_streams\n"
        "with lasting_streams(), open(sys.argv[1], 'w') as file:\n    file.write(str(file.fileno()))\n"
    )
    script = '"$PYTHON" -c "$1" "$2" <&- >&- 2>&-'
    environ = {**os.environ, "PYTHON": sys.executable, "PYTHONPATH": str(ROOT)}
    words = ["/bin/bash", "-c", script, "bash", opens, str(tmp_path / "file")]
    assert subprocess.run(words, env=environ, timeout=PATIENCE_S).returncode == 0
    assert int((tmp_path / "file").read_text()) > 2  # else a library that writes to standard output writes into it


def test_what_cannot_be_written_for_another_reason_is_told() -> None:
    words = [sys.executable, "-m", "edqn_jax", "--version"]
    with open("/dev/full", "w") as stdout:
        ended = subprocess.run(words, cwd=ROOT, stdout=stdout, stderr=subprocess.PIPE, text=True, timeout=PATIENCE_S)
    assert (ended.returncode, ended.stderr) == (
        2,
        "edqn: standard output cannot be written: No space left on device\n",
    )
