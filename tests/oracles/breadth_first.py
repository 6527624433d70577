"""Textbook breadth-first search over a lattice: one queue, one cell at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

Cell = tuple[int, ...]


def hop_counts(sources: Iterable[Cell], neighbours: Callable[[Cell], Iterable[Cell]]) -> dict[Cell, int]:
    """Returns the hops from the nearest source to every cell that can be reached."""
    hops = dict.fromkeys(sources, 0)
    queue = deque(hops)
    while queue:
        here = queue.popleft()
        for there in neighbours(here):
            if there not in hops:
                hops[there] = hops[here] + 1
                queue.append(there)
    return hops
