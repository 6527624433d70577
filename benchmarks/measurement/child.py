"""A process that a benchmark keeps alive and asks in turns: what each side of the conversation needs.

The child says one line of JSON when it is ready, and one for each line that it is asked, until its input ends.
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
    """The child has ended instead of answering; the message is the last that it said on its standard error."""


class Child:
    """The asking side. A context, at whose end the process ends."""

    def __init__(self, checkout: Path, script: Path, words: Sequence[str], complaints: Path) -> None:
        """Starts `script` with `words`, with the package and the benchmarks of `checkout`.

        Its standard error goes to the file `complaints`.
        """
        self.complaints = complaints
        # Before all else the checkout's own; what else this process was given comes after.
        own = (str(checkout), str(checkout / "benchmarks"))
        path = os.pathsep.join(filter(None, (*own, os.environ.get("PYTHONPATH"))))
        # Several processes share the accelerator, if there is one.
        environment = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", **os.environ, "PYTHONPATH": path}
        with complaints.open("w", encoding="utf-8") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-P", str(script), *words],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                bufsize=1,
            )

    def ask(self, line: str) -> Any:
        """What the child answers to `line`.

        Raises:
            ChildEndedError: if it does not.
        """
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended: there will be no answer
            self.process.stdin.write(line + "\n")
        return self.answer()

    def answer(self) -> Any:
        """The next thing that the child says.

        Raises:
            ChildEndedError: if it has ended.
        """
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            said = self.complaints.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            raise ChildEndedError(said[-1] if said else "it said nothing")
        return json.loads(line)

    def __enter__(self) -> Child:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()


def answers() -> TextIO:
    """Where the child's answers go; from here on whatever else prints goes to its standard error."""
    stream = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    return stream
