"""How a run is asked to stop."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager


@dataclasses.dataclass(frozen=True)
class Stop:
    """What a run asks after each chunk; by default nothing stops it."""

    requested: Callable[[], bool] = lambda: False
    """Whether to stop; if it returns True on one process, all stop."""
    obeyed: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext
    """Surrounds the time in which the run asks: outside of it a signal ends the process."""
