"""When drones of a group hit each other, in the plainest way: a walk in small steps of time, in double precision."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def walked(path: NDArray, flies: NDArray, until: NDArray, reach: float, parts: int = 400) -> NDArray:
    """Returns when each drone first comes within `reach` of another, [N] physics steps, inf where it does not.

    At each of `parts` moments of a physics step, the two that are nearest are taken out where they touch.

    Args:
        path: [N, n + 1, 3] metres, before the first physics step and after each.
        flies: [N] bool.
        until: [N] physics steps, after which a drone is not there.
        reach: metres.
        parts: of each physics step.
    """
    path = np.asarray(path, np.float64)
    count, rows = path.shape[:2]
    hit = np.full(count, np.inf)
    moments = np.arange((rows - 1) * parts + 1)
    step = np.minimum(moments // parts, rows - 2)
    share = (moments / parts - step)[:, None]
    at = (1 - share) * path[:, step] + share * path[:, step + 1]
    apart = np.linalg.norm(at[:, None] - at[None], axis=-1)  # [N, N, moments]
    for moment in moments[(apart[np.triu_indices(count, 1)] <= reach).any(axis=0)]:
        time = moment / parts
        while True:
            there = [i for i in range(count) if flies[i] and np.isinf(hit[i]) and time <= until[i]]
            near = [(apart[i, j, moment], i, j) for i in there for j in there if i < j]
            if not near or min(near)[0] > reach:
                break
            _, i, j = min(near)
            hit[i] = hit[j] = time
    return hit
