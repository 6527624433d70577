"""Processes on this machine that train together over loopback, or one alone."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]

WORLD = """<mujoco><worldbody>
  <site name="start" pos="2 2 3"/><site name="goal" pos="20 10 6"/>
  <site name="volume" type="box" pos="12 8 8" size="12 8 8" group="3"/>
  <geom type="sphere" pos="10 15 5" size="3"/>
</worldbody></mujoco>"""
"""Quicker to compile for than the paper's."""

PATIENCE_S = 1200
"""What hangs for longer has failed."""

LAUNCHERS = ("JAX_COORDINATOR", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID", "SLURM_", "OMPI_", "KUBERNETES_")
"""Beginnings of the variables that would tell a process that it is one of several."""

Process = subprocess.Popen[str]

Launcher = Callable[[int, int], tuple[list[str], dict[str, str]]]


def by_hand(port: int, number: int) -> tuple[list[str], dict[str, str]]:
    """Flags and variables of process `number` of two."""
    return ["--coordinator-address", f"127.0.0.1:{port}", "--num-processes", "2", "--process-id", str(number)], {}


def by_srun(port: int, number: int) -> tuple[list[str], dict[str, str]]:
    """The variables that Slurm's srun sets for task `number` of two."""
    return [], {
        "SLURM_JOB_ID": "7",
        "SLURM_STEP_NODELIST": "localhost",
        "SLURM_NTASKS": "2",
        "SLURM_STEP_NUM_TASKS": "2",
        "SLURM_PROCID": str(number),
        "SLURM_LOCALID": str(number),
        "JAX_COORDINATOR_PORT": str(port),
    }


@contextmanager
def two_processes(folder: Path, argv: list[str], launcher: Launcher = by_hand) -> Iterator[list[Process]]:
    """`tests/support/cluster_process.py` twice, in `folder`, a device each; neither outlives the block.

    Their notes are `note-0.json` and `note-1.json`.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    processes = []
    try:
        for number in range(2):
            flags, variables = launcher(port, number)
            processes.append(_start(folder, [f"note-{number}.json", "1", *argv, *flags], variables))
        yield processes
    finally:
        _end(processes)


@contextmanager
def one_process(folder: Path, argv: list[str]) -> Iterator[Process]:
    """`tests/support/cluster_process.py` alone, in `folder`, with two devices; its note is `note.json`."""
    process = _start(folder, ["note.json", "2", *argv], {})
    try:
        yield process
    finally:
        _end([process])


def to_the_end(*processes: Process) -> list[tuple[int, str]]:
    """Waits for the processes and returns the exit code and output of each."""
    outputs = [process.communicate(timeout=PATIENCE_S)[0] for process in processes]
    return [(process.returncode, output) for process, output in zip(processes, outputs, strict=True)]


def _start(folder: Path, argv: list[str], variables: dict[str, str]) -> Process:
    alone = {name: value for name, value in os.environ.items() if not name.startswith(LAUNCHERS)}
    return subprocess.Popen(
        [sys.executable, "-m", "tests.support.cluster_process", *argv],
        cwd=folder,
        env={**alone, "PYTHONPATH": str(ROOT), **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def _end(processes: list[Process]) -> None:
    for process in processes:
        process.kill()
        process.communicate()
