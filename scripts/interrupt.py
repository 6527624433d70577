"""Interrupts training at random moments, continues it, and compares the end with that of a run left alone.

    python scripts/interrupt.py --times 50                    # kill -9
    python scripts/interrupt.py --times 20 --signal TERM
    python scripts/interrupt.py --times 20 --signal DISK      # no file may grow beyond a random size
    python scripts/interrupt.py --times 5 --signal PEER       # kill -9 for one of two processes that train together

A small agent is trained in the paper's world, with a checkpoint every half second. Each run is interrupted up to four
times, at moments drawn over its whole length, start-up and drawing included, and then left to end. Its last state,
metrics and episodes must be those of the uninterrupted run to the last bit. A process that loses the other one must end
within a minute, with a sentence. Fifty interruptions take twenty minutes on two cores. Exit code 1 if one of them lost
something.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from edqn_jax.runs.directory import RunDirectory

ROOT = Path(__file__).resolve().parents[1]

FLAGS = (
    *("--tuned-for", "cpu", "--world", "paper"),
    *("--num-envs", "16", "--total-steps", "16000", "--train.chunk-steps", "16"),
    *("--agent.batch-size", "16", "--agent.replay-size", "4096", "--agent.learning-starts", "64"),
    *("--encoder.warmup-decisions", "1024", "--encoder.batch-size", "16", "--encoder.replay-size", "512"),
    *("--camera.width", "8", "--camera.height", "6", "--drone.physics", "rigid_body", "--train.devices", "1"),
    *("--train.validation-every", "4000", "--train.validation-missions", "4", "--world.missions", "16"),
    *("--train.checkpoint-every-s", "0.5", "--train.checkpoints", "3"),
)
"""Options of train.py."""

MOST_A_RUN = 4
"""Interruptions of one run, after which it is left to end."""

MOST_ALONE_S = 60.0
"""Within which a process ends that has lost the other one."""

CLOCKS = ("decisions_per_second",)
"""Metrics that tell the time."""


def main(argv: Sequence[str] | None = None) -> int:
    """Returns 0 if nothing was lost, else 1."""
    parser = argparse.ArgumentParser(
        prog="python scripts/interrupt.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--times", type=int, default=50, help="interruptions (default 50)")
    parser.add_argument(
        "--signal",
        choices=["KILL", "TERM", "INT", "DISK", "PEER"],
        default="KILL",
        help="sent to a run (default KILL); DISK: none, the run meets a full disk; PEER: KILL to one of two processes",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default 0)")
    args = parser.parse_args(argv)
    draw = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "programs"))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        processes = 2 if args.signal == "PEER" else 1
        to_the_end(folder / "warm", processes)  # its programs are compiled for all
        began = time.monotonic()
        code = to_the_end(folder / "whole", processes)
        seconds = time.monotonic() - began
        if code:
            print((folder / "whole.log").read_text(), file=sys.stderr)
            return 1
        expected, done, runs, lost = ending(folder / "whole"), 0, 0, 0
        print(f"a run takes {seconds:.1f} s", flush=True)
        while done < args.times:
            runs += 1
            run = folder / f"run-{runs}"
            most = min(MOST_A_RUN, args.times - done)
            if args.signal == "DISK":
                times, saved = filled(run, most, draw)
            elif args.signal == "PEER":
                times, saved = bereft(run, most, seconds, draw)
            else:
                times, saved = interrupted(run, most, seconds, draw, args.signal)
            done += times
            code = 0 if RunDirectory(run).is_finished else to_the_end(run, processes)
            if code == 0:
                differs = first_difference(expected, ending(run))
            else:
                differs = f"exit code {code}:\n{(folder / f'{run.name}.log').read_text()}"
            if code == 0 and differs:
                # Whose end is the odd one? The uninterrupted run once more tells.
                repeated = folder / f"whole-{runs}"
                to_the_end(repeated, processes)
                again = first_difference(expected, ending(repeated))
                differs += f"; uninterrupted once more: {again or 'ends as the first time'}"
            lost += bool(differs)
            says = f"DIFFERS ({differs})" if differs else "ends alike"
            print(f"run {runs}: {times} interruptions, continued from {saved}: {says}", flush=True)
            shutil.rmtree(run)
    by = {"DISK": "full disks", "PEER": "the loss of a process"}.get(args.signal, f"SIG{args.signal}")
    print(f"{done} interruptions by {by} of {runs} runs: {runs - lost} of {runs} end alike")
    return 1 if lost else 0


def to_the_end(run: Path, processes: int) -> int:
    """Begins or continues a run, by one process or several; returns the largest of their exit codes."""
    if processes == 1:
        return begin(run).wait()
    return max(process.wait() for process in begin_together(run))


def begin_together(run: Path) -> list[subprocess.Popen[bytes]]:
    """Begins or continues a run with two processes, of a device each."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    together = ("--train.devices", "2", "--coordinator-address", f"127.0.0.1:{port}", "--num-processes", "2")
    return [begin(run, *together, "--process-id", str(number)) for number in range(2)]


def begin(run: Path, *more: str) -> subprocess.Popen[bytes]:
    """Begins or continues a run; what it prints is in a file beside its folder."""
    with (run.parent / f"{run.name}.log").open("ab") as log:
        return subprocess.Popen([*command(run), *more], stdout=log, stderr=subprocess.STDOUT)


def command(run: Path) -> list[str]:
    """Returns the words that begin or continue a run."""
    return [sys.executable, str(ROOT / "train.py"), *FLAGS, "--run-dir", str(run)]


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
        saved.append(newest(run))
    return len(saved), saved


def filled(run: Path, most: int, draw: random.Random) -> tuple[int, list[str]]:
    """Has a run meet a full disk up to `most` times; returns as `interrupted`."""
    saved = []
    for _ in range(most):
        size = int(10 ** draw.uniform(2.0, 6.0))  # bytes; the largest file of the run has about a megabyte
        limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (size, size))
        ended = subprocess.run(command(run), capture_output=True, text=True, preexec_fn=limit)
        said = ended.stdout + ended.stderr
        if ended.returncode not in (0, 2) or "Traceback" in said or (ended.returncode == 2 and "edqn: " not in said):
            raise SystemExit(f"'{run.name}' with files of {size} bytes ended with {ended.returncode}:\n{said}")
        saved.append(f"{newest(run)} ({size:,} bytes)")
        if RunDirectory(run).is_finished:
            break
    return len(saved), saved


def bereft(run: Path, most: int, seconds: float, draw: random.Random) -> tuple[int, list[str]]:
    """Kills one of a run's two processes up to `most` times; returns as `interrupted`."""
    saved = []
    for _ in range(most):
        both = begin_together(run)
        while not (run / "config.yaml").exists() and all(process.poll() is None for process in both):
            time.sleep(0.1)  # until then they look for each other, five minutes at most
        time.sleep(draw.uniform(0.0, seconds))
        if RunDirectory(run).is_finished or any(process.poll() is not None for process in both):
            for process in both:
                process.wait()
            break
        lost, left = draw.sample(both, 2)
        lost.kill()
        began = time.monotonic()
        code = left.wait()
        took = time.monotonic() - began
        log = (run.parent / f"{run.name}.log").read_text()
        # While it compiles, XLA ends it at once, with a sentence and a trace of its own.
        said = "another process" in log if code == 1 else code == -signal.SIGABRT and "another task died" in log
        if not said or took > MOST_ALONE_S or "Traceback" in log:
            raise SystemExit(f"the process left of '{run.name}' ended with exit code {code} after {took:.1f} s:\n{log}")
        saved.append(f"{newest(run)} (the other ended after {took:.1f} s)")
    return len(saved), saved


def newest(run: Path) -> str:
    """Returns the name of a run's newest checkpoint."""
    names = sorted(place.name for place in run.glob("checkpoints/step-*.safetensors"))
    return names[-1] if names else "the beginning"


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


def first_difference(expected: dict[str, Any], found: dict[str, Any]) -> str:
    """Returns where the ends of two runs differ first; nothing where they are alike."""
    for one, other in itertools.zip_longest(expected["metrics"], found["metrics"], fillvalue={}):
        for name in one:
            if one[name] != other.get(name):
                return f"{name} after {one['decisions']} decisions is {other.get(name)}, not {one[name]}"
    return ", ".join(name for name in expected if expected[name] != found[name])


if __name__ == "__main__":
    sys.exit(main())
