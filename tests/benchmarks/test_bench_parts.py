"""The pytest-benchmark suite runs, and covers every part."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from measurement.parts import PARTS
from tests.support.miniature import MINIATURE

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_the_suite_runs_a_part_when_nothing_is_timed() -> None:
    words = ["-n0", "--benchmark-disable", "-v", "-k", "acting", "benchmarks/bench_parts.py"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *words],
        cwd=ROOT,
        env={**os.environ, "EDQN_FLAGS": " ".join(MINIATURE)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"1 passed, {len(PARTS) - 1} deselected" in done.stdout
