"""Two processes on this machine that train together over loopback."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from edqn_jax.config import Config
from edqn_jax.resolve import to_yaml

ROOT = Path(__file__).parents[1]

PATIENCE_S = 600
"""What hangs for longer has failed."""

LAUNCHERS = ("JAX_", "SLURM_", "OMPI_", "KUBERNETES_")
"""Beginnings of the variables that would tell a process that it is one of several."""

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
def two_processes(folder: Path, argv: list[str], launcher: Launcher = by_hand) -> Iterator[list[subprocess.Popen[str]]]:
    """`tests/cluster_process.py` twice, in `folder`; whatever happens, neither outlives the block."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    alone = {name: value for name, value in os.environ.items() if not name.startswith(LAUNCHERS)}
    processes = []
    try:
        for number in range(2):
            flags, variables = launcher(port, number)
            processes.append(
                subprocess.Popen(
                    [sys.executable, "-m", "tests.cluster_process", f"note-{number}.json", *argv, *flags],
                    cwd=folder,
                    env={**alone, "PYTHONPATH": str(ROOT), **variables},
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                )
            )
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def to_the_end(processes: list[subprocess.Popen[str]]) -> list[tuple[int, str]]:
    """Exit code and output of each."""
    outputs = [process.communicate(timeout=PATIENCE_S)[0] for process in processes]
    return [(process.returncode, output) for process, output in zip(processes, outputs, strict=True)]


def arguments_for(config: Config, folder: Path) -> list[str]:
    """Arguments of `edqn train` for this configuration, which is left in a file in `folder`."""
    file = folder / "knobs.yaml"
    file.write_text(to_yaml(config), encoding="utf-8")
    return ["--config", str(file)]
