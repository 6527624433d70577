"""A fleet spread over processes with one shared memory; this process simulates the first share."""

from __future__ import annotations

import ctypes
import multiprocessing
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from conventional_stack.fleet import Course, Fleet, Record
from edqn_jax.config import Config

_RESET, _STEP = b"reset", b"step"


class SpreadFleet:
    """`drones` drones in `processes` processes; `record` holds all of them."""

    def __init__(
        self, config: Config, course: Course, drones: int, processes: int, seed: int, camera: str = "rays"
    ) -> None:
        """Starts the other processes, with one of `fleet.CAMERAS`; `close` ends them.

        Raises:
            ConfigError: if this stack does not support the configuration.
            ValueError: if the number of drones is not a multiple of the number of processes.
        """
        if drones < 1 or processes < 1 or drones % processes:
            raise ValueError(
                f"{drones} drones cannot be divided among {processes} processes; the number must be a multiple"
            )
        # Spawned, not forked, because the threads of JAX and PyTorch do not survive a fork.
        context = multiprocessing.get_context("spawn")
        shared = {
            name: (context.RawArray(ctypes.c_byte, int(np.prod(shape)) * np.dtype(kind).itemsize), shape, kind)
            for name, (shape, kind) in Record.shapes(config, drones).items()
        }
        self.record = _mapped(shared)
        each = drones // processes
        self.fleet = Fleet(config, course, self.record.part(slice(0, each)), seed, camera)
        self.workers = []
        for number in range(1, processes):
            ours, theirs = context.Pipe()
            share = slice(number * each, (number + 1) * each)
            process = context.Process(
                target=_serve, args=(theirs, config, course, shared, share, seed + number, camera), daemon=True
            )
            process.start()
            theirs.close()
            self.workers.append((process, ours))
        self.stopwatch = self.fleet.stopwatch

    def reset(self) -> None:
        """Starts a new mission for every drone."""
        self._together(_RESET, self.fleet.reset)

    def step(self) -> None:
        """Simulates one decision of every drone; drones whose episode ended start a new mission."""
        self._together(_STEP, self.fleet.step)

    def _together(self, word: bytes, own_share) -> None:
        for _, pipe in self.workers:
            pipe.send_bytes(word)
        own_share()
        with self.stopwatch.time("waiting"):
            for _, pipe in self.workers:
                try:
                    pipe.recv_bytes()
                except EOFError:
                    raise RuntimeError("a process of the conventional stack ended early") from None

    def close(self) -> None:
        """Ends the other processes."""
        for process, pipe in self.workers:
            pipe.close()
            process.join()
        self.workers = []


def _mapped(shared: dict[str, Any]) -> Record:
    return Record(
        **{name: np.frombuffer(memory, kind).reshape(shape) for name, (memory, shape, kind) in shared.items()}
    )


def _serve(
    pipe: Connection, config: Config, course: Course, shared: dict[str, Any], share: slice, seed: int, camera: str
) -> None:
    """Runs in another process: executes requests until the pipe is closed."""
    fleet = Fleet(config, course, _mapped(shared).part(share), seed, camera)
    requests = {_RESET: fleet.reset, _STEP: fleet.step}
    while True:
        try:
            word = pipe.recv_bytes()
        except EOFError:
            return
        requests[word]()
        pipe.send_bytes(word)
