"""Products of factors that are rounded to bfloat16, number by number."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def to_bfloat16(x: ArrayLike) -> NDArray[np.float64]:
    """Returns the nearest numbers with eight bits of mantissa, of two as near the one whose last bit is 0."""
    mantissa, exponent = np.frexp(np.asarray(x, np.float64))
    return np.ldexp(np.rint(mantissa * 256) / 256, exponent)


def product(left: ArrayLike, right: ArrayLike) -> NDArray[np.float64]:
    """Returns the product [M, N] of factors [M, K] and [K, N]."""
    return to_bfloat16(left) @ to_bfloat16(right)
