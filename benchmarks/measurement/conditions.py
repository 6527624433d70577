"""What a machine was like while a figure was measured: how fast a core is, and who else had the cores meanwhile.

A slow processor has a low rate of products and nobody beside us; a slow hour has time that was stolen by the host of a
virtual machine, cores that are busy with other processes, or time for which a container was stopped by its quota.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

PROC, CGROUP = Path("/proc"), Path("/sys/fs/cgroup")

PIECES, PIECE_SECONDS = 20, 0.01
SIDE, COUNT = 64, 256
"""Products of matrices this small are computed by one thread."""

BUSY, STOLEN, FIELDS = (0, 1, 2, 5, 6), 7, 8
"""Columns of /proc/stat: user, nice, system, irq and softirq; steal; and how many are counted, without guests."""


def product_rates() -> list[float]:
    """Returns the flop/s of one thread in float32 products, of `PIECES` pieces that take 0.2 s together.

    The highest is the processor's; the median is below it where the core was taken away meanwhile.
    """
    a = np.full((COUNT, SIDE, SIDE), 0.5, np.float32)
    out = np.empty_like(a)
    np.matmul(a, a, out=out)
    rates = []
    for _ in range(PIECES):
        began, done = time.perf_counter(), 0
        while (passed := time.perf_counter() - began) < PIECE_SECONDS:
            np.matmul(a, a, out=out)
            done += 1
        rates.append(done * COUNT * 2.0 * SIDE**3 / passed)
    return rates


class Watch:
    """Counts from its making on what others take of the machine."""

    def __init__(self) -> None:
        self.began, self.own, self.ticks, self.stopped = time.perf_counter(), _own_seconds(), _ticks(), _throttled()

    def so_far(self) -> dict[str, float | None]:
        """Returns what happened since; None for what the system does not tell.

        Returns:
            seconds; load: processes that run or wait, a mean over a minute; cores_busy: by this process and its ended
            children, and cores_busy_with_others, mean numbers; steal: share of the time of all cores that a virtual
            machine was not given; throttled_seconds: for which the quota of a container stopped it.
        """
        seconds = max(time.perf_counter() - self.began, 1e-9)
        own = (_own_seconds() - self.own) / seconds
        now, stopped = _ticks(), _throttled()
        steal = others = None
        if now is not None and self.ticks is not None:
            passed = now - self.ticks
            whole = float(passed.sum())
            if whole > 0:
                busy = float(passed[list(BUSY)].sum())
                steal = float(passed[STOLEN]) / whole
                others = max(busy / os.sysconf("SC_CLK_TCK") / seconds - own, 0.0)
        return {
            "seconds": seconds,
            "load": os.getloadavg()[0],
            "cores_busy": own,
            "cores_busy_with_others": others,
            "steal": steal,
            "throttled_seconds": None if stopped is None or self.stopped is None else stopped - self.stopped,
        }


def middle(seen: Sequence[dict[str, float | None]]) -> dict[str, float | None]:
    """Returns the medians of what several watches saw, and their seconds in all."""
    known = {name: [one for each in seen if (one := each[name]) is not None] for name in seen[0]}
    medians = {name: statistics.median(values) if values else None for name, values in known.items()}
    return medians | {"seconds": sum(known["seconds"])}


def rates() -> dict[str, float | None]:
    """Returns the rate of one thread in products, highest and median, and the quota of cores."""
    found = product_rates()
    return {"product_flops": max(found), "product_flops_median": statistics.median(found), "quota_cores": _quota()}


def conditions(watch: Watch) -> dict[str, float | None]:
    """Returns what `watch` saw, and `rates`."""
    return watch.so_far() | rates()


def sentence(seen: dict[str, Any]) -> str:
    """Returns `conditions` as a line."""
    highest, median = seen["product_flops"] / 1e9, seen["product_flops_median"] / 1e9
    parts = [f"{highest:.0f} Gflop/s of products a thread (median {median:.0f})", f"load {seen['load']:.2f}"]
    if seen["steal"] is not None:
        parts += [f"{seen['cores_busy_with_others']:.2f} cores busy with others", f"{seen['steal']:.1%} stolen"]
    if seen["quota_cores"] is not None:
        parts.append(f"a quota of {seen['quota_cores']:g} cores, stopped for {seen['throttled_seconds'] or 0:.1f} s")
    return ", ".join(parts) + f", over {seen['seconds']:.0f} s"


def _own_seconds() -> float:
    """Returns the seconds of processors that this process and its ended children have used."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def _ticks() -> np.ndarray | None:
    """Returns the ticks [FIELDS] of all cores since the machine started; None where they are not counted."""

    def read() -> np.ndarray:
        first = (PROC / "stat").read_text(encoding="ascii").split("\n", 1)[0].split()
        return np.array([int(field) for field in first[1 : 1 + FIELDS]], np.int64)

    found = _or_none(read)
    return found if found is not None and len(found) == FIELDS else None


def _throttled() -> float | None:
    """Returns the seconds for which this container was stopped by its quota; None where there is none."""

    def read() -> float:
        lines = (CGROUP / "cpu.stat").read_text(encoding="ascii").splitlines()
        return int(dict(line.split() for line in lines)["throttled_usec"]) / 1e6

    return _or_none(read)


def _quota() -> float | None:
    """Returns how many cores this container may use on average; None without a limit."""

    def read() -> float:
        quota, period = (CGROUP / "cpu.max").read_text(encoding="ascii").split()
        return int(quota) / int(period)

    return _or_none(read)


def _or_none(read: Callable[[], Any]) -> Any:
    try:
        return read()
    except (OSError, ValueError, KeyError):
        return None
