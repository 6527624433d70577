"""Parameters of tests that plain `pytest` leaves out."""

from __future__ import annotations

from typing import Any

import pytest


def in_whole(*values: Any) -> list[Any]:
    """Returns each value as a parameter that `pytest -m whole` tests and plain `pytest` does not."""
    return rows_in_whole(*((value,) for value in values))


def rows_in_whole(*rows: tuple[Any, ...]) -> list[Any]:
    """Returns rows of values, for tests with several parameters, as `in_whole`."""
    return [pytest.param(*row, marks=pytest.mark.whole) for row in rows]
