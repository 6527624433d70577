"""Limits of single options, written in their types, such as `Annotated[float, between(0, 1)]`, and what checks them."""

from __future__ import annotations

import functools
import math
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from edqn_jax.errors import ConfigError, suggest_nearest


@dataclass(frozen=True)
class Limit:
    """What the value of an option must be, in words, and a function that says whether it is."""

    says: str
    holds: Callable[[Any], bool]
    names: tuple[str, ...] = ()
    """That the value may be; of these the nearest is named."""

    def __repr__(self) -> str:
        return f"'{self.says}'"


def at_least(least: float) -> Limit:
    """Returns the limit of values that are not too small, nor infinite."""
    return Limit(f"at least {least}", lambda value: least <= value < math.inf)


def at_most(most: float) -> Limit:
    """Returns the limit of values that are not too large, such as sizes that no machine has memory for."""
    return Limit(f"at most {most}", lambda value: value <= most)


def less_than(limit: float, said: str) -> Limit:
    """Returns the limit of values below one that is said in a word."""
    return Limit(f"less than {said}", lambda value: value < limit)


def between(low: float, high: float) -> Limit:
    """Returns the limit of values from `low` to `high`."""
    return Limit(f"between {low:g} and {high:g}", lambda value: low <= value <= high)


def one_of(names: tuple[str, ...]) -> Limit:
    """Returns the limit of a value that is one of some names; what it says has all of them."""
    return Limit(f"one of {', '.join(names)}", lambda value: value in names, names)


COUNT = at_least(1)
POSITIVE = Limit("more than 0", lambda value: 0 < value < math.inf)
NOT_NEGATIVE = Limit("0 or more", lambda value: 0 <= value < math.inf)
FINITE = Limit("a finite number", math.isfinite)
SHARE = between(0, 1)
RATE = Limit("more than 0 and at most 1", lambda value: 0 < value <= 1)
DEVIATION = Limit("at least 0 and less than 1", lambda value: 0 <= value < 1)
"""Share by which a positive number may change so that something of it is left."""
BELOW_1 = Limit("more than 0 and less than 1", lambda value: 0 < value < 1)
GRADIENT_NORM = Limit("more than 0 (inf clips nothing)", lambda value: value > 0)
ON_OR_OFF = Limit("0 or 1", lambda value: value in (0, 1))
WIDTHS = Limit("one or more widths of at least 1", lambda widths: min(widths, default=0) >= 1)
SHARES = Limit("three shares between 0 and 1", lambda values: all(0 <= value <= 1 for value in values))
RISING_SHARES = Limit("shares between 0 and 1 in rising order", lambda values: _rises((0, *values, 1)))
LEAST_AND_MOST = Limit(
    "two numbers above 0, the least and the most", lambda values: 0 < values[0] <= values[1] < math.inf
)
TWO_TIMES = Limit("at least two times, the last 0", lambda times: len(times) >= 2)
LAST_AT_0 = Limit("times that end at 0, the decision", lambda times: times[-1] == 0)
RISING_TIMES = Limit("times in rising order", lambda times: _rises(times))


@functools.cache
def limits_of(section: type) -> dict[str, list[Limit]]:
    """Returns the limits of a group's options by their names; [] of an option that has none."""
    hints = typing.get_type_hints(section, include_extras=True)
    return {
        name: [said for said in getattr(hint, "__metadata__", ()) if isinstance(said, Limit)]
        for name, hint in hints.items()
    }


def check_limits(section: Any, group: str) -> None:
    """Raises unless every option of a group is within its own limits.

    Raises:
        ConfigError: names the first option that is not, and its limit.
    """
    for name, limits in limits_of(type(section)).items():
        for limit in limits:
            value = getattr(section, name)
            if limit.names and not limit.holds(value):
                raise ConfigError(f"{group}.{name}: there is no '{value}'{suggest_nearest(value, limit.names)}")
            require(limit.holds(value), f"{group}.{name}", limit.says, value)


def require(holds: bool, name: str, limit: str, value: object) -> None:
    """Raises unless an option of this name and value is as its limit says.

    Raises:
        ConfigError: names the option, its limit and its value.
    """
    if not holds:
        said = ", ".join(map(_short, value)) or "an empty list" if isinstance(value, tuple) else value_text(value)
        raise ConfigError(f"{name} must be {limit}, not {said}")


def value_text(value: object) -> str:
    """Returns a value as text; a whole number of very many digits without them."""
    return "a huge number" if isinstance(value, int) and abs(value) >= 10**18 else str(value)


def _rises(values: Sequence[float]) -> bool:
    """Returns whether each value is above the one before it."""
    return all(earlier < later for earlier, later in pairwise(values))


def _short(value: object) -> str:
    """Returns an item of a list as text."""
    return f"{value:g}" if isinstance(value, float) else value_text(value)
