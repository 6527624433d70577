"""ESIM's law frame by frame, in NumPy: what evlib's simulator does, without PyTorch and several times as fast."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

EPSILON = 1e-3
"""Darkest brightness of which the logarithm is taken."""


class Esim:
    """Pixels that remember the log brightness at their last event."""

    def __init__(self, contrast: float) -> None:
        """Prepares a camera whose events each tell a change of log brightness by `contrast`."""
        self._contrast = np.float32(contrast)
        self._last: NDArray[np.float32] | None = None
        self._left = np.zeros((), np.float32)

    def events(self, frame: ArrayLike) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.int8]]:
        """Returns columns, rows and signs [N] of the events since the last frame; of the first frame none.

        Args:
            frame: [H, W] brightness, 1 for white.
        """
        log = np.log(np.maximum(np.asarray(frame, np.float32), np.float32(EPSILON)))
        if self._last is None:
            self._last, self._left = log, np.zeros_like(log)
        self._left += log - self._last
        self._last = log
        count = np.trunc(self._left / self._contrast)
        self._left -= count * self._contrast
        pixels = np.flatnonzero(count)
        many = count.ravel()[pixels].astype(np.int64)
        pixels, signs = np.repeat(pixels, np.abs(many)), np.repeat(np.sign(many).astype(np.int8), np.abs(many))
        rows, columns = np.divmod(pixels, log.shape[1])
        return columns, rows, signs
