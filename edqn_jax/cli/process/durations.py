"""How long each phase of a command took the last time, kept beside the compiled programs.

Nobody knows how long a compiler will take, but the last time is mostly much like the next.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping

from edqn_jax.errors import ConfigError
from edqn_jax.files import cache_folder, write_atomically

FILE = "durations.json"

LEAST_S = 1.0
"""Shorter phases are over before one has read how long they take, and are not kept."""

MOST = 500
"""Phases that are kept, the newest ones."""

AS_ASKED = ("starting", "training", "warm-up", "retraining", "validating")
"""Phases that take as long as one asks for, or are over before anything is read."""


class Durations:
    """The phases of one command: how long each took the last time, and takes now."""

    def __init__(self, title: str) -> None:
        """Reads what is kept of the command of this title."""
        self._title, self._last, self._took = title, read_durations(), {}
        self._name, self._began = "", time.monotonic()

    def begin(self, name: str) -> None:
        """Ends the phase before, unless it is this one, and begins one.

        The last phase of a command may be cut short, and is not kept.
        """
        if name != self._name:
            now = time.monotonic()
            if self._name and self._name not in AS_ASKED:
                self._took[self._key(self._name)] = now - self._began
            self._name, self._began = name, now

    def last(self, name: str) -> float | None:
        """Returns the seconds that a phase took the last time, if that is known and longer than nothing."""
        return self._last.get(self._key(name))

    def keep(self) -> None:
        """Keeps how long the phases that have ended took."""
        keep_durations(self._took)

    def _key(self, name: str) -> str:
        return f"{self._title}: {name}"


def read_durations() -> dict[str, float]:
    """Returns what is kept, seconds by command and phase; nothing where the file is missing or damaged."""
    try:
        kept = json.loads((cache_folder() / FILE).read_text(encoding="utf-8"))
    except (OSError, RuntimeError, ValueError):  # there is no home, or it is not JSON
        return {}
    if not isinstance(kept, dict):
        return {}
    return {name: float(seconds) for name, seconds in kept.items() if isinstance(seconds, int | float)}


def keep_durations(took: Mapping[str, float]) -> None:
    """Keeps seconds by command and phase for the next time; nothing where the folder cannot be written."""
    new = {name: round(seconds, 1) for name, seconds in took.items() if seconds >= LEAST_S}
    if not new:
        return
    old = {name: seconds for name, seconds in read_durations().items() if name not in new}
    newest = dict([*old.items(), *new.items()][-MOST:])
    try:
        folder = cache_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            write_atomically(folder / FILE, json.dumps(newest, indent=1))
    except (OSError, RuntimeError, ConfigError):
        return
