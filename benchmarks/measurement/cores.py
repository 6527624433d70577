"""The cores that a benchmark uses."""

from __future__ import annotations

import os
from collections.abc import Iterable


def own_cores() -> list[int]:
    """Returns the numbers of the cores that this process may use."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def keep_to(chosen: Iterable[int]) -> None:
    """Keeps this process, and the threads and processes that it starts, to these cores, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, set(chosen))
