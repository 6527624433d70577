"""A process that a benchmark keeps running and sends requests to: both ends of the pipe.

The child prints one line of JSON when it is ready and one in answer to each line of its input, until the input ends.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO


class ChildEndedError(RuntimeError):
    """The child ended instead of answering; the message is the last line of its standard error."""


class Child:
    """The parent's end. A context manager; the child is killed when the block ends."""

    def __init__(self, checkout: Path, script: Path, words: Sequence[str], log: Path) -> None:
        """Starts a script that imports the package and the benchmarks of a checkout.

        Args:
            checkout: folder that has `edqn_jax` and `benchmarks`.
            script: what Python runs.
            words: its arguments.
            log: file for its standard error.
        """
        self.log = log
        own = (str(checkout), str(checkout / "benchmarks"))
        path = os.pathsep.join(filter(None, (*own, os.environ.get("PYTHONPATH"))))
        # Without preallocation, because several processes share the accelerator if there is one.
        environment = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", **os.environ, "PYTHONPATH": path}
        with log.open("w", encoding="utf-8") as errors:
            self.process = subprocess.Popen(
                [sys.executable, "-P", str(script), *words],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                bufsize=1,
            )

    def ask(self, line: str) -> Any:
        """Sends one line and returns the answer.

        Raises:
            ChildEndedError: if there is no answer.
        """
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended; `answer` says so
            self.process.stdin.write(line + "\n")
        return self.answer()

    def answer(self) -> Any:
        """Returns the next line that the child prints, parsed.

        Raises:
            ChildEndedError: if the child has ended.
        """
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            errors = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            raise ChildEndedError(errors[-1] if errors else "it printed no error")
        return json.loads(line)

    def __enter__(self) -> Child:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()


def answers() -> TextIO:
    """Returns the stream for the child's answers; all other output goes to standard error from here on."""
    stream = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    return stream
