"""A process that is kept alive and asked in turns, and the memory that it holds."""

from __future__ import annotations

import multiprocessing
import time
from pathlib import Path

import pytest

from measurement import peak_memory
from measurement.child import Child, ChildEndedError

ROOT = Path(__file__).resolve().parents[2]


def test_a_child_answers_in_turns_and_its_end_is_told_with_its_last_words(tmp_path: Path) -> None:
    script = tmp_path / "echo.py"
    script.write_text(
        "import sys\n"
        "from measurement.child import answers\n"
        "stream = answers()\n"
        "print('not an answer')\n"
        "print('{\"ready\": 1}', file=stream)\n"
        "for line in sys.stdin:\n"
        "    print(int(line) * 2, file=stream)\n"
    )
    with Child(ROOT, script, [], tmp_path / "said.log") as child:
        assert child.answer() == {"ready": 1}
        assert (child.ask("4"), child.ask("5")) == (8, 10)
        with pytest.raises(ChildEndedError, match="^ValueError: invalid literal .* 'x"):
            child.ask("x")
    assert "not an answer" in (tmp_path / "said.log").read_text()


def test_the_memory_of_a_child_is_not_what_its_parent_held_before(tmp_path: Path) -> None:
    held = bytearray(b"1") * 400_000_000  # written, so that it is really there
    script = tmp_path / "light.py"
    script.write_text(
        "import sys\n"
        "from measurement.child import answers\n"
        "from measurement.peak_memory import peak_of\n"
        "stream = answers()\n"
        "for line in sys.stdin:\n"
        "    own = bytearray(b'1') * int(line)\n"
        "    print(peak_of(), file=stream)\n"
    )
    with Child(ROOT, script, [], tmp_path / "said.log") as child:
        del held
        # Python itself takes some 10 MB; what the child held and freed is still counted.
        first, second, third = child.ask("0"), child.ask("100000000"), child.ask("0")
    assert first < 100e6
    assert 100e6 < second < 200e6 and third > 100e6


def test_the_memory_of_other_processes_is_counted_while_they_run() -> None:
    assert peak_memory.peak_of_workers() == 0
    worker = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    worker.start()
    try:
        assert 0 < peak_memory.peak_of_workers() <= (peak_memory.peak_of(worker.pid or 0) or 0)
    finally:
        worker.kill()
        worker.join()
    assert peak_memory.peak_of_workers() == 0
