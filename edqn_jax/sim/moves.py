"""The moves that a drone can make: a grid of directions in the heading frame."""

from __future__ import annotations

import numpy as np

ACTIONS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(27, 3)
"""The 27 moves, {-1, 0, 1}^3: ahead, left, up in the heading frame."""

_LENGTHS = np.linalg.norm(ACTIONS, axis=1)

DIRECTIONS = (ACTIONS[_LENGTHS > 0] / _LENGTHS[_LENGTHS > 0, None]).astype(np.float32)
"""Unit directions [26, 3] of the moves other than standing still, in their order."""
