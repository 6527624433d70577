"""Interrupts training at random moments, continues it, and compares the end with that of a run left alone.

    python scripts/interrupt.py --times 50                    # kill -9
    python scripts/interrupt.py --times 20 --signal TERM

A small agent is trained in the paper's world, with a checkpoint every half second. Each run is interrupted up to four
times, at moments drawn over its whole length, start-up and drawing included, and then left to end. Its last state,
metrics and episodes must be those of the uninterrupted run to the last bit. Fifty interruptions take twenty minutes on
two cores. Exit code 1 if one of them lost something.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edqn_jax.runs.directory import RunDirectory

ROOT = Path(__file__).resolve().parents[1]

FLAGS = (
    *("--world", "paper", "--num-envs", "16", "--total-steps", "16000", "--train.chunk-steps", "16"),
    *("--agent.batch-size", "16", "--agent.replay-size", "4096", "--agent.learning-starts", "64"),
    *("--encoder.warmup-decisions", "1024", "--encoder.batch-size", "16", "--encoder.replay-size", "512"),
    *("--camera.width", "8", "--camera.height", "6", "--drone.physics", "rigid_body", "--train.devices", "1"),
    *("--train.validation-every", "4000", "--train.validation-missions", "4", "--world.missions", "16"),
    *("--train.checkpoint-every-s", "0.5", "--train.checkpoints", "3"),
)
"""Options of train.py."""

MOST_A_RUN = 4
"""Interruptions of one run, after which it is left to end."""

CLOCKS = ("decisions_per_second",)
"""Metrics that tell the time."""


def main(argv: Sequence[str] | None = None) -> int:
    """Returns 0 if nothing was lost, else 1."""
    parser = argparse.ArgumentParser(
        prog="python scripts/interrupt.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--times", type=int, default=50, help="interruptions (default 50)")
    parser.add_argument(
        "--signal", choices=["KILL", "TERM", "INT"], default="KILL", help="sent to a run (default KILL)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default 0)")
    args = parser.parse_args(argv)
    draw = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "programs"))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        begin(folder / "warm").wait()  # its programs are compiled for all
        began = time.monotonic()
        code = begin(folder / "whole").wait()
        seconds = time.monotonic() - began
        if code:
            print((folder / "whole.log").read_text(), file=sys.stderr)
            return 1
        expected, done, runs, lost = ending(folder / "whole"), 0, 0, 0
        print(f"a run takes {seconds:.1f} s", flush=True)
        while done < args.times:
            runs += 1
            run = folder / f"run-{runs}"
            times, saved = interrupted(run, min(MOST_A_RUN, args.times - done), seconds, draw, args.signal)
            done += times
            code = 0 if RunDirectory(run).finished else begin(run).wait()
            same = code == 0 and ending(run) == expected
            lost += not same
            says = "ends alike" if same else f"DIFFERS (exit code {code}):\n{(folder / f'{run.name}.log').read_text()}"
            print(f"run {runs}: {times} interruptions, continued from {saved}: {says}", flush=True)
            shutil.rmtree(run)
    print(f"{done} interruptions by SIG{args.signal} of {runs} runs: {runs - lost} of {runs} end alike")
    return 1 if lost else 0


def begin(run: Path) -> subprocess.Popen[bytes]:
    """Begins or continues a run; what it prints is in a file beside its folder."""
    words = [sys.executable, str(ROOT / "train.py"), *FLAGS, "--run-dir", str(run)]
    with (run.parent / f"{run.name}.log").open("ab") as log:
        return subprocess.Popen(words, stdout=log, stderr=subprocess.STDOUT)


def interrupted(run: Path, most: int, seconds: float, draw: random.Random, name: str) -> tuple[int, list[str]]:
    """Interrupts a run up to `most` times; returns how often, and the newest checkpoint after each."""
    saved = []
    for _ in range(most):
        process = begin(run)
        try:
            process.wait(timeout=draw.uniform(0.0, seconds))
            break  # before its moment came
        except subprocess.TimeoutExpired:
            process.send_signal(getattr(signal, f"SIG{name}"))
            code, number = process.wait(), getattr(signal, f"SIG{name}")
            if code not in (-number, 128 + number, 0):  # 0: it ended just then
                raise SystemExit(f"'{run.name}' ended with exit code {code}") from None
        names = sorted(place.name for place in run.glob("checkpoints/step-*") if place.name[-1].isdigit())
        saved.append(names[-1] if names else "the beginning")
    return len(saved), saved


def ending(run: Path) -> dict[str, Any]:
    """Returns what a finished run leaves that tells no time."""
    summary = json.loads((run / "summary.json").read_text())
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return {
        "state": summary["state_digest"],
        "metrics": [{name: value for name, value in row.items() if name not in CLOCKS} for row in rows],
        "episodes": (run / "episodes.csv").read_text(),
        "trajectory": (run / "trajectory.csv").read_text(),
    }


if __name__ == "__main__":
    sys.exit(main())
