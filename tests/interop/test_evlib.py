"""The simulated camera's events beside those of evlib's ESIM."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edqn_jax.fly.simulated.esim import Esim
from edqn_jax.interop.outer.event_cameras import CONTRAST, esim


def test_its_events_are_evlibs() -> None:
    ours, theirs = Esim(CONTRAST), esim()
    y, x = np.mgrid[:40, :60]

    def image(columns: NDArray, rows: NDArray, signs: NDArray) -> NDArray:
        counts = np.zeros((40, 60))
        np.add.at(counts, (rows, columns), signs)
        return counts

    total, other = 0, 0.0
    for k in range(30):
        frame = 0.5 + 0.49 * np.sin(0.3 * x + 0.2 * y + 0.2 * k) * np.cos(0.1 * x - 0.3 * k)
        packet = theirs(frame, 0.005 * k)
        total += len(packet)
        other += float(np.abs(image(*ours.events(frame)) - image(packet["x"], packet["y"], packet["p"])).sum())
    assert total > 10_000 and other <= 1e-4 * total  # a level may be rounded to the other side
