"""The order of four columns that nothing names: found where only the usual one fits, and refused elsewhere."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.interop.recordings.recording import MAX_PIXELS

ORDER = ("t", "x", "y", "p")
"""The usual one: the event camera dataset of Zurich, ESIM, v2e."""

MAX_STEPS_BACK = 0.2
"""Largest share of steps back in a column of times: sorted files have none, and random columns half."""

ORDERS = [order for order in itertools.permutations(ORDER) if order.index("x") < order.index("y")]
"""All in which x stands before y: nothing in the numbers tells these two apart."""


def check_usual_order(name: str, columns: list[NDArray]) -> None:
    """Raises unless four columns [N] can be t, x, y and p, and none of them but the first can be the time.

    Raises:
        ConfigError: names the orders that are possible.
    """
    may_be = {
        "t": [_may_be_time(column) for column in columns],
        "p": [_may_be_polarity(column) for column in columns],
    }
    may_be["x"] = may_be["y"] = [_may_be_pixel(column) for column in columns]
    if not any(may_be["p"]):
        kinds = ", ".join(f"{kind:g}" for kind in np.unique(columns[-1])[:5].astype(float))
        raise ConfigError(
            f"no column of '{name}' has the polarities 0 and 1, or -1 and 1, alone; the last one has {kinds}"
        )
    possible = [order for order in ORDERS if all(may_be[key][place] for place, key in enumerate(order))]
    if possible == [ORDER]:
        return
    options = " or ".join(",".join(order) for order in possible[:4])
    which = f"which may be {options}" if possible else "which are t, x, y and p in no order"
    raise ConfigError(f"'{name}' does not name its columns, {which}; give --columns")


def _may_be_time(column: NDArray) -> bool:
    """Returns whether a column rises, or has numbers that no other can have."""
    if not _may_be_pixel(column) and not _may_be_polarity(column):
        return True
    steps = np.diff(column)
    return bool(column[-1] > column[0] and np.mean(steps < 0) <= MAX_STEPS_BACK and not _may_be_polarity(column))


def _may_be_pixel(column: NDArray) -> bool:
    return bool(np.all((column >= 0) & (column < MAX_PIXELS) & (column == np.floor(column))))


def _may_be_polarity(column: NDArray) -> bool:
    return bool(np.all((column == 0) | (column == 1)) or np.all((column == -1) | (column == 1)))
