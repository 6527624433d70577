"""A recording of events, and from whatever columns a file holds to the one form that this package uses.

Events are a structured array [N] of `STREAM_DTYPE`, sorted by time: `t` int64 microseconds, `x` and `y` uint16 pixels,
`p` int8, 1 where it grew brighter and -1 where darker. What a file does not say is found where only one reading is
plausible; otherwise it is refused with a sentence that names the option to give.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.sim.sensors.events import STREAM_DTYPE

TimeUnit = Literal["s", "ms", "us", "ns"]

MICROSECONDS: dict[TimeUnit, float] = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
"""By unit."""

PLAUSIBLE_SECONDS = (1e-3, 86_400.0)
"""Shortest and longest recording that a unit of time is found for."""

PLAUSIBLE_RATE_HZ = (100.0, 3e7)
"""Fewest and most events per second, averaged over a recording."""

EPOCH_SECONDS = (1.0e9, 2.2e9)
"""Seconds since 1970 that a clock shows between 2001 and 2039."""

MOST_BACK_US = 1_000_000
"""Furthest that time may go back from one event to the next; events that are less out of order are sorted."""

MOST_PIXELS = 2**16
"""Bound of each side of an image."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """Events with all that is known of the camera that made them."""

    events: NDArray
    """[N] of `STREAM_DTYPE`, sorted by time."""
    width: int | None = None
    """Pixels across; None where it is not known."""
    height: int | None = None
    time_unit: str = "us, as written"
    """Unit of the times in the file, and how it is known."""
    polarity: str = "-1 and 1"
    """How the file writes OFF and ON."""
    out_of_order: int = 0
    """Events that came before an earlier one in the file."""
    contrast: float | None = None
    """Change of log brightness that made an event; None where it is not known."""
    flight: Mapping[str, NDArray] | None = None
    """Where the camera was: `t` [T] microseconds, `position` [T, 3], `quaternion` [T, 4], `velocity` [T, 3], `move`
    [T, 3] of the decision that was being flown; None where it is not known."""

    @property
    def seconds(self) -> float:
        """Returns the time from the first event to the last."""
        return float(self.events["t"][-1] - self.events["t"][0]) * 1e-6 if len(self.events) else 0.0

    def between(self, start_s: float | None, stop_s: float | None) -> Recording:
        """Returns the part from `start_s` to `stop_s` seconds after the first event; None leaves an end open.

        Raises:
            ConfigError: if there are no events in it.
        """
        if start_s is None and stop_s is None:
            return self
        t = self.events["t"]
        first, last = np.searchsorted(t, [_after(t, start_s, t[0]), _after(t, stop_s, t[-1] + 1)])
        if first >= last:
            raise ConfigError(f"there are no events from {start_s or 0:g} s on; the recording lasts {self.seconds:g} s")
        return dataclasses.replace(self, events=self.events[first:last])

    def size(self) -> tuple[int, int]:
        """Returns width and height.

        Raises:
            ConfigError: if they are not known.
        """
        if self.width is None or self.height is None:
            raise ConfigError(
                "the file does not say how large the image is; give --size W H, at least "
                f"{int(self.events['x'].max()) + 1} {int(self.events['y'].max()) + 1}"
            )
        return self.width, self.height


def _after(t: NDArray, seconds: float | None, default: int) -> int:
    return int(default) if seconds is None else int(t[0]) + round(seconds * 1e6)


def recording_of(
    name: str,
    *,
    t: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    p: ArrayLike,
    size: tuple[int, int] | None = None,
    time_unit: TimeUnit | None = None,
    offset_us: int = 0,
    **known: Any,
) -> Recording:
    """Returns the recording of four columns [N].

    Args:
        name: of the file, for messages.
        t: times of any unit, integers or not.
        x: column of the pixel.
        y: row of the pixel.
        p: polarity: 0 and 1, -1 and 1, or truth values.
        size: width and height of the image.
        time_unit: of `t`; None finds it.
        offset_us: added to the times, microseconds.
        known: other fields of `Recording`.

    Raises:
        ConfigError: if the columns are no events, or can be read in several ways.
    """
    columns = {"t": np.asarray(t), "x": np.asarray(x), "y": np.asarray(y), "p": np.asarray(p)}
    lengths = {len(column) if column.ndim == 1 else -1 for column in columns.values()}
    if len(lengths) != 1 or -1 in lengths:
        shapes = ", ".join(f"{key} {list(column.shape)}" for key, column in columns.items())
        raise ConfigError(f"'{name}' is damaged: t, x, y and p must be columns of one length, not {shapes}")
    if not len(columns["t"]):
        raise ConfigError(f"'{name}' holds no events")
    for key, column in columns.items():
        if column.dtype.kind not in "biuf" or not np.all(np.isfinite(column)):
            raise ConfigError(f"'{name}' is damaged: its column {key} is not all finite numbers")
    for key, limit in (("x", size and size[0]), ("y", size and size[1])):
        _check_pixels(name, key, columns[key], limit)
    unit = time_unit or found_unit(name, columns["t"])
    events = np.empty(len(columns["t"]), STREAM_DTYPE)
    events["t"] = _microseconds(name, columns["t"], unit) + offset_us
    events["x"], events["y"] = columns["x"], columns["y"]
    events["p"], polarity = signs(name, columns["p"])
    events, out_of_order = _in_order(name, events)
    width, height = size or (None, None)
    return Recording(
        events,
        width,
        height,
        time_unit=known.pop("says_unit", None) or f"{unit}, {'as given' if time_unit else 'the only plausible unit'}",
        polarity=polarity,
        out_of_order=out_of_order,
        **known,
    )


def found_unit(name: str, t: NDArray) -> TimeUnit:
    """Returns the only unit in which times [N] are plausible: since 1970, or by length, rate and resolution.

    Raises:
        ConfigError: if there is none, or more than one.
    """
    first, length = float(t[0]), float(t.max() - t.min())
    whole = bool(np.all(t == np.floor(t)))
    for unit, factor in MICROSECONDS.items():
        if EPOCH_SECONDS[0] <= first * factor * 1e-6 <= EPOCH_SECONDS[1] and (unit == "s" or first > 1e11):
            return unit
    found: list[TimeUnit] = []
    for unit, factor in MICROSECONDS.items():
        seconds = length * factor * 1e-6
        rate = len(t) / seconds if seconds > 0.0 else np.inf
        fine = unit != "s" if whole else unit in ("s", "ms")
        plausible = PLAUSIBLE_SECONDS[0] <= seconds <= PLAUSIBLE_SECONDS[1]
        if plausible and fine and PLAUSIBLE_RATE_HZ[0] <= rate <= PLAUSIBLE_RATE_HZ[1]:
            found.append(unit)
    if len(found) == 1:
        return found[0]
    which = f"which may be {' or '.join(found)}" if found else "and in none of them it is a plausible recording"
    raise ConfigError(f"'{name}' does not say the unit of its times, {which}; give --time-unit s, ms, us or ns")


def signs(name: str, p: NDArray) -> tuple[NDArray[np.int8], str]:
    """Returns polarities [N] as -1 and 1, and how the file writes them.

    Raises:
        ConfigError: if they are neither 0 and 1 nor -1 and 1.
    """
    lowest, highest = p.min(), p.max()
    numbers = p.astype(np.int8)
    if np.all(p == numbers):
        if lowest >= 0 and highest <= 1:
            return (2 * numbers - 1).astype(np.int8), "0 and 1" if lowest == 0 else "1 alone"
        if lowest == -1 and highest <= 1 and np.all(numbers != 0):
            return numbers, "-1 and 1"
    kinds = ", ".join(f"{kind:g}" for kind in np.unique(p)[:5].astype(float))
    raise ConfigError(f"the polarities of '{name}' must be 0 and 1, or -1 and 1, not {kinds}")


def _check_pixels(name: str, key: str, column: NDArray, limit: int | None) -> None:
    lowest, highest = column.min(), column.max()
    if column.dtype.kind == "f" and np.any(column != np.floor(column)):
        raise ConfigError(
            f"'{name}' has pixels {key} that are no whole numbers, such as {column[column % 1 != 0][0]:g}"
        )
    if lowest < 0 or highest >= MOST_PIXELS or (limit is not None and highest >= limit):
        most = (limit or MOST_PIXELS) - 1
        raise ConfigError(f"'{name}' has pixels {key} from {lowest:g} to {highest:g}; they must be from 0 to {most}")


def _microseconds(name: str, t: NDArray, unit: TimeUnit) -> NDArray[np.int64]:
    factor = MICROSECONDS[unit]
    if max(abs(float(t.min())), abs(float(t.max()))) * factor > 2.0**62:
        raise ConfigError(f"'{name}' has times in {unit} that are beyond all clocks; give --time-unit")
    if t.dtype.kind == "f":
        return np.rint(t.astype(np.float64) * factor).astype(np.int64)
    whole = t.astype(np.int64)
    return whole // 1000 if unit == "ns" else whole * round(factor)


def _in_order(name: str, events: NDArray) -> tuple[NDArray, int]:
    """Returns the events sorted by time, and how many were not.

    Raises:
        ConfigError: if time goes back so far that they are not one recording.
    """
    back = -np.diff(events["t"])
    if not back.size or back.max() <= 0:
        return events, 0
    if back.max() > MOST_BACK_US:
        where = int(back.argmax()) + 1
        raise ConfigError(
            f"time goes back by {back.max() * 1e-6:g} s at event {where:,} of '{name}': it is damaged, or several "
            "recordings in one file"
        )
    return events[np.argsort(events["t"], kind="stable")], int(np.count_nonzero(back > 0))
