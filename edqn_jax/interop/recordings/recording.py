"""A recording of events, and from whatever columns a file holds to the one form that this package uses.

Events are a structured array [N] of `STREAM_DTYPE`, sorted by time: `t` int64 microseconds, `x` and `y` uint16 pixels,
`p` int8, 1 where it grew brighter and -1 where darker. What a file does not say is found where only one reading is
plausible; otherwise it is refused with a sentence that names the option to give.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.sim.sensors.event_field import STREAM_DTYPE

TimeUnit = Literal["s", "ms", "us", "ns"]

MICROSECONDS: dict[TimeUnit, float] = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
"""By unit."""

PLAUSIBLE_SECONDS = (1e-3, 86_400.0)
"""Shortest and longest recording that a unit of time is found for."""

PLAUSIBLE_RATE_HZ = (100.0, 3e7)
"""Fewest and most events per second, averaged over a recording."""

EPOCH_SECONDS = (1.0e9, 2.2e9)
"""Seconds since 1970 that a clock shows between 2001 and 2039."""

EPOCH_RATE_HZ = 1.0
"""Fewest events per second of a recording whose clock counts from 1970: a clock that began with the camera shows the
same numbers in a finer unit."""

COLUMN_NAMES = {
    **dict.fromkeys(("t", "ts", "time", "times", "timestamp", "timestamps"), "t"),
    **dict.fromkeys(("x", "xs"), "x"),
    **dict.fromkeys(("y", "ys"), "y"),
    **dict.fromkeys(("p", "ps", "pol", "polarity", "polarities", "on"), "p"),
}
"""What files call the columns, in lower case."""

MAX_BACK_US = 1_000_000
"""Furthest that time may go back from one event to the next; events that are less out of order are sorted."""

MAX_PIXELS = 2**16
"""Bound of each side of an image."""


@dataclasses.dataclass(frozen=True)
class Pictures:
    """Pictures that the camera took beside its events."""

    until_us: NDArray[np.int64]
    """[P] end of each exposure, on the events' clock, in order."""
    image: Callable[[int], NDArray[np.uint8]]
    """Returns the picture [H, W] of a number, grey."""

    def newest(self, end_us: int) -> NDArray[np.uint8]:
        """Returns the last picture [H, W] that was taken by a moment; before there is one, the first."""
        return self.image(max(int(np.searchsorted(self.until_us, end_us, side="right")) - 1, 0))


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
    columns: str = ""
    """Order of a text's columns, and how it is known; empty where they have names."""
    out_of_order: int = 0
    """Events that stand in the file behind a later one."""
    left_out: int = 0
    """Events of a camera's file that stand before its first words of time and row, and have none."""
    contrast: float | None = None
    """Change of log brightness that made an event; None where it is not known."""
    pictures: Pictures | None = None
    """None where the file has none."""
    flight: Mapping[str, NDArray] | None = None
    """Where the camera was: `t` [T] microseconds, `position` [T, 3], `quaternion` [T, 4], `velocity` [T, 3], `move`
    [T, 3] of the decision that was being flown, of other actions than moves the direction that was commanded, and their
    numbers as `action`; None where it is not known."""

    @property
    def longest_pause_s(self) -> float:
        """Returns the longest time between an event and the next."""
        return float(np.diff(self.events["t"]).max()) * 1e-6 if len(self.events) > 1 else 0.0

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
    if size is not None and min(size) < 1:
        raise ConfigError(f"the image of '{name}' must have at least 1 x 1 pixels, not {size[0]} x {size[1]}")
    columns = {"t": np.asarray(t), "x": np.asarray(x), "y": np.asarray(y), "p": np.asarray(p)}
    lengths = {len(column) if column.ndim == 1 else -1 for column in columns.values()}
    if len(lengths) != 1 or -1 in lengths:
        shapes = ", ".join(f"{key} {list(column.shape)}" for key, column in columns.items())
        raise ConfigError(f"t, x, y and p of '{name}' must be columns of one length, not {shapes}")
    if not len(columns["t"]):
        raise ConfigError(f"'{name}' holds no events")
    for key, column in columns.items():
        if column.dtype.kind not in "biuf" or not np.all(np.isfinite(column)):
            raise ConfigError(f"the column {key} of '{name}' is not all finite numbers")
    for key, limit in (("x", size and size[0]), ("y", size and size[1])):
        _check_pixels(name, key, columns[key], limit)
    unit = time_unit or infer_time_unit(name, columns["t"])
    events = np.empty(len(columns["t"]), STREAM_DTYPE)
    events["t"] = _microseconds(name, columns["t"], unit) + offset_us
    events["x"], events["y"] = columns["x"], columns["y"]
    events["p"], polarity = polarity_signs(name, columns["p"])
    events, out_of_order = _in_order(name, events)
    width, height = size or (None, None)
    return Recording(
        events,
        width,
        height,
        time_unit=known.pop("says_unit", None)
        or f"{unit}, {'as given' if time_unit else 'assumed from length, rate and resolution'}",
        polarity=polarity,
        out_of_order=out_of_order,
        **known,
    )


def infer_time_unit(name: str, t: NDArray) -> TimeUnit:
    """Returns the only unit in which times [N] are plausible: since 1970, or by length, rate and resolution.

    Raises:
        ConfigError: if there is none, or more than one.
    """
    first, length = float(t[0]), float(t.max()) - float(t.min())
    whole = bool(np.all(t == np.floor(t)))
    since_1970: list[TimeUnit] = []
    found: list[TimeUnit] = []
    for unit, factor in MICROSECONDS.items():
        if unit == ("s" if whole else "ns"):  # such times would all lie on whole seconds, or within a nanosecond
            continue
        seconds = length * factor * 1e-6
        rate = len(t) / seconds if seconds > 0.0 else np.inf
        if EPOCH_SECONDS[0] <= first * factor * 1e-6 <= EPOCH_SECONDS[1]:
            if seconds <= PLAUSIBLE_SECONDS[1] and rate >= EPOCH_RATE_HZ:
                since_1970.append(unit)
        if PLAUSIBLE_SECONDS[0] <= seconds <= PLAUSIBLE_SECONDS[1]:
            if PLAUSIBLE_RATE_HZ[0] <= rate <= PLAUSIBLE_RATE_HZ[1]:
                found.append(unit)
    found = since_1970 or found
    if len(found) == 1:
        return found[0]
    which = f"which may be {' or '.join(found)}" if found else "and in none of them it is a plausible recording"
    raise ConfigError(f"'{name}' does not say the unit of its times, {which}; give --time-unit s, ms, us or ns")


def match_columns(names: Iterable[str]) -> dict[str, str] | None:
    """Returns which of the names is that of t, x, y and p; None unless there is one of each."""
    found: dict[str, str] = {}
    for name in names:
        key = COLUMN_NAMES.get(name.lower())
        if key in found:
            return None
        if key is not None:
            found[key] = name
    return found if len(found) == len("txyp") else None


def one_number(name: str, key: str, value: ArrayLike) -> float | int:
    """Returns the number that a file has under a key, be it by itself or as an array of one.

    Raises:
        ConfigError: if it is none.
    """
    held = np.asarray(value)
    if held.size != 1 or held.dtype.kind not in "iuf" or not np.isfinite(held).all():
        word = held.reshape(-1)[0] if held.size == 1 else None
        text = word.decode("latin-1") if isinstance(word, bytes) else str(word)
        said = f"an array {list(held.shape)}" if held.size != 1 else f"'{text}'"
        raise ConfigError(f"the {key} of '{name}' must be one number, not {said}")
    return held.reshape(-1)[0].item()


def whole_number(name: str, key: str, value: ArrayLike) -> int:
    """Returns the whole number that a file has under a key.

    Raises:
        ConfigError: if it is none.
    """
    number = one_number(name, key, value)
    if number != int(number):
        raise ConfigError(f"the {key} of '{name}' must be a whole number, not {number:g}")
    return int(number)


def polarity_signs(name: str, p: NDArray) -> tuple[NDArray[np.int8], str]:
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
    if lowest < 0 or highest >= MAX_PIXELS or (limit is not None and highest >= limit):
        most = (limit or MAX_PIXELS) - 1
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
    """Returns the events sorted by time, and how many stood behind a later one.

    Raises:
        ConfigError: if time goes back so far that they are not one recording.
    """
    back = np.maximum.accumulate(events["t"]) - events["t"]
    furthest = int(back.argmax())
    if back[furthest] > MAX_BACK_US:
        raise ConfigError(
            f"time goes back by {back[furthest] * 1e-6:g} s at event {furthest:,} of '{name}': it is damaged, or "
            "several recordings in one file"
        )
    if not back[furthest]:
        return events, 0
    return events[np.argsort(events["t"], kind="stable")], int(np.count_nonzero(back))
