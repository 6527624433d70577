"""What the commands of all benchmarks share."""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from edqn_jax.extras import MissingPackageError
from tests.support.processes import PATIENCE_S, ROOT


@in_a_sentence
def main(argv: Sequence[str]) -> int:
    parser = Parser("example", "Times an example.", epilog="It takes a second.")
    parser.add_argument("--calls", type=at_least_one, default=7)
    args = parser.parse(argv)
    if args.calls == 3:
        raise MissingPackageError("three is not installed")
    return 10 + args.calls


def test_options_are_read(tmp_path: Path) -> None:
    assert main([]) == 17
    assert main(["--calls", "2", "--json", str(tmp_path / "report.json")]) == 12


def test_a_report_that_cannot_be_written_and_a_missing_package_are_sentences(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--json", str(tmp_path / "no" / "report.json")]) == 2
    assert main(["--calls", "3"]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert "report.json' cannot be written: there is no folder" in first and second == "three is not installed"


@pytest.mark.parametrize("word", ["0", "-1", "2.5", "x"])
def test_what_is_no_number_of_calls_is_refused(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--calls", word])
    assert ended.value.code == 2
    assert f"--calls: must be a whole number of at least 1, not {word}" in capsys.readouterr().err


def test_the_help_says_what_is_timed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    said = capsys.readouterr().out
    assert "python benchmarks/example.py" in said and "Times an example." in said and "It takes a second." in said
    assert "write the report to this file" in said


def test_a_benchmark_has_a_clock_on_standard_error_before_it_imports_what_takes_long() -> None:
    environ = {**os.environ, "PYTHONPATH": str(ROOT)}
    program = [sys.executable, "-X", "importtime", ROOT / "benchmarks" / "verdicts.py", "--help"]
    ended = subprocess.run(program, capture_output=True, text=True, env=environ, timeout=PATIENCE_S)
    assert ended.returncode == 0 and ended.stdout.startswith("usage: python benchmarks/verdicts.py")
    before, clock, after = ended.stderr.partition("verdicts: starting, 0:0")
    imported = re.compile(r"\| +jax$", re.MULTILINE)
    assert clock and imported.search(after) and not imported.search(before)


def test_what_is_no_benchmark_has_no_clock(capfd: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 17 and capfd.readouterr() == ("", "")
