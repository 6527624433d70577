"""Peak memory of processes."""

from __future__ import annotations

import multiprocessing
import resource
import sys
from pathlib import Path


def peak_of(process: int | str = "self") -> int | None:
    """Returns the peak memory of a running process since its program started, bytes; None if it is not available.

    On Linux `ru_maxrss` starts at the memory of the parent process, so it is used only on other systems, where the
    value is available only for this process.
    """
    try:
        status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    except OSError:
        if process != "self" or sys.platform == "linux":
            return None
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    peaks = [int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmHWM:")]
    return peaks[0] if peaks else None  # none for a process that has ended


def peak_of_workers() -> int:
    """Returns the sum of `peak_of` over the running processes that this one has started with `multiprocessing`."""
    return sum(peak_of(worker.pid) or 0 for worker in multiprocessing.active_children() if worker.pid is not None)
