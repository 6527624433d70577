"""Parameters of tests that plain `pytest` leaves out."""

from __future__ import annotations

from typing import Any

import pytest


def in_whole(*values: Any) -> list[Any]:
    """Returns each value as a parameter that `pytest -m whole` tests and plain `pytest` does not."""
    return [pytest.param(value, marks=pytest.mark.whole) for value in values]
