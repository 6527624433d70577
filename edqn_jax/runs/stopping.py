"""Requests to stop a run."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager


@dataclasses.dataclass(frozen=True)
class Stop:
    """Stop request that a run polls after each chunk; by default it never stops."""

    is_requested: Callable[[], bool] = lambda: False
    """Whether to stop; if it returns True on one process, all stop."""
    obey_signals: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext
    """Context in which the run polls: outside of it a signal ends the process."""
