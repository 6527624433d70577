"""The event simulator under the paper's law (Eq. 1-4), in numba.

Between two frames the events of a pixel have one polarity and equal spacing (Eq. 5), so the signed count defines them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from edqn_jax.config import EventsConfig
from edqn_jax.extras import require_extra
from edqn_jax.sim.sensors.events import max_events

numba = require_extra("numba")


class Law(NamedTuple):
    """The paper's law as plain numbers."""

    threshold: float
    tolerance: float
    limit: int  # N_max of Eq. 3
    epsilon: float


def law_of(config: EventsConfig) -> Law:
    """Returns the law of a configuration with two frames."""
    first, second = config.frame_times_s
    return Law(config.threshold, config.tolerance, max_events(config, second - first), config.log_epsilon)


@numba.njit(cache=True, error_model="numpy")
def signed_counts(law, before, after, counts):
    """Computes the events of each pixel between two frames, ON positive and OFF negative, limited to int8.

    Args:
        before, after: [N, P] linear luma in [0, 1].
        counts: [N, P] int8, output.
    """
    for i in range(len(counts)):
        for p in range(counts.shape[1]):
            change = math.log((after[i, p] + law.epsilon) / (before[i, p] + law.epsilon))
            size = abs(change)
            number = 0
            if size > law.threshold:
                number = min(int(size / law.tolerance), law.limit, 127)
            counts[i, p] = number if change > 0 else -number
