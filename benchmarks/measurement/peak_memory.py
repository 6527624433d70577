"""Memory that processes have held."""

from __future__ import annotations

import multiprocessing
import resource
import sys
from pathlib import Path


def peak_of(process: int | str = "self") -> int | None:
    """The most bytes that a running process has held since its program began; None where that cannot be known.

    `ru_maxrss` of a process on Linux begins at what its parent held before it, so it is for other systems, where
    only this process's own is known.
    """
    try:
        status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    except OSError:
        if process != "self" or sys.platform == "linux":
            return None
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    peaks = [int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmHWM:")]
    return peaks[0] if peaks else None  # one that has ended has none


def peak_of_workers() -> int:
    """The sum of `peak_of` the processes that this one has started through `multiprocessing` and that run."""
    return sum(peak_of(worker.pid) or 0 for worker in multiprocessing.active_children() if worker.pid is not None)
