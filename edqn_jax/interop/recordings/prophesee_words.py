"""Events in the words of Prophesee's EVT2, EVT3 and DAT, decoded with whole arrays.

Times come out as the file has them, in the file's order: nothing is moved, so that what runs back is seen by
`recording_of`. A clock of few bits begins again at zero; the words that carry its upper bits may also repeat an older
value for a moment, as real cameras do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edqn_jax.interop.recordings.recording import MAX_BACK_US

MAX_AHEAD_US = 10_000_000
"""Longest pause in which a clock may begin again at zero, as in Prophesee's own decoder."""


class Columns(NamedTuple):
    """Events as columns [N], in the file's order."""

    t: NDArray[np.int64]
    """Microseconds."""
    x: NDArray
    y: NDArray
    p: NDArray[np.int8]
    """0 or 1."""
    left_out: int = 0
    """Events before the first words that say the time, or the row: they have none."""


class Words(NamedTuple):
    """How a format is decoded."""

    dtype: np.dtype
    """Of a word."""
    decode: Callable[[NDArray], Columns]
    """Turns words [M] into events."""


def running_clock(values: NDArray, period: int, tick_us: int) -> NDArray[np.int64]:
    """Returns the values [M] of a clock that begins again at zero, counted on over these beginnings.

    A smaller value is a new beginning where that is at most `MAX_AHEAD_US`, or half a period, later; otherwise the
    clock stepped back. A larger one may be a step back over a beginning, of at most `MAX_BACK_US`.

    Args:
        values: whole numbers from 0 to `period` - 1.
        period: number of values.
        tick_us: microseconds of one.
    """
    values = values.astype(np.int64)
    step = np.diff(values)
    ahead = min(MAX_AHEAD_US // tick_us, period // 2)
    behind = min(MAX_BACK_US // tick_us, period // 2 - 1)
    begins = (step < 0) & (step + period <= ahead)
    slips = (step > 0) & (period - step <= behind)
    return values + period * np.cumsum(np.concatenate(([0], begins.astype(np.int64) - slips)))[: len(values)]


def decode_evt2(words: NDArray) -> Columns:
    """Returns the events of words [M] of EVT 2.0: 4 bits of kind, 6 of time, 11 of column, 11 of row."""
    kinds = words >> 28
    high_at, at = np.flatnonzero(kinds == 0x8), np.flatnonzero(kinds <= 0x1)
    high = _latest(high_at, at)
    known = high >= 0
    held = words[at[known]]
    clock = running_clock(words[high_at] & 0xFFFFFFF, 1 << 28, 64)
    t = (clock[high[known]] << 6) + (held >> 22 & 0x3F)
    return Columns(t, held >> 11 & 0x7FF, held & 0x7FF, (held >> 28).astype(np.int8), int((~known).sum()))


def decode_evt3(words: NDArray) -> Columns:
    """Returns the events of words [M] of EVT 3.0: 4 bits of kind, 12 of value.

    A column is written by itself (0x2), or as bits of the 12 or 8 columns (0x4, 0x5) from a base (0x3) on, which each
    such word moves on. Row (0x0), upper (0x8) and lower (0x6) 12 bits of the time hold until the next word of their
    kind; the lower are 0 after the upper changed, as in Prophesee's own decoder.
    """
    kinds, values = words >> 12, words & 0xFFF
    row_at, base_at, low_at, high_at = (np.flatnonzero(kinds == kind) for kind in (0x0, 0x3, 0x6, 0x8))
    at = np.flatnonzero((kinds == 0x2) | (kinds == 0x4) | (kinds == 0x5))
    kind, value = kinds[at], values[at]
    is_vector = kind != 0x2
    bits = np.select([kind == 0x2, kind == 0x5], [np.uint16(1), value & 0xFF], value)
    row, base, low, high = (_latest(places, at) for places in (row_at, base_at, low_at, high_at))

    # Each word of bits moves its base on by as many columns as it has bits.
    width = np.select([kind == 0x2, kind == 0x5], [0, 8], 12)
    moved = np.append(np.cumsum(width) - width, 0)
    pixel = np.where(is_vector, _take_or_first(values[base_at], base), value)
    since = moved[:-1] - moved[_take_or_first(np.searchsorted(at, base_at), base)]
    column = (pixel & 0x7FF).astype(np.int64) + np.where(is_vector, since, 0)

    clock = running_clock(values[high_at], 1 << 12, 1 << 12)
    change_at = high_at[np.flatnonzero(np.diff(clock, prepend=-1))]
    is_low_known = _take_or_first(low_at, low) > _take_or_first(change_at, _latest(change_at, at))
    t = (_take_or_first(clock, high) << 12) + np.where(
        is_low_known & (low >= 0), _take_or_first(values[low_at], low), 0
    )

    known = (high >= 0) & (row >= 0) & ~(is_vector & (base < 0))
    count = np.where(known, np.bitwise_count(bits), 0).astype(np.int64)
    event = np.repeat(np.arange(len(at)), count)
    shift = np.zeros(len(event), np.int64)
    written = bits[known & is_vector, None] >> np.arange(12, dtype=np.uint16) & 1
    shift[is_vector[event]] = np.nonzero(written)[1]
    return Columns(
        t[event],
        column[event] + shift,
        _take_or_first(values[row_at] & 0x7FF, row)[event],
        (pixel >> 11).astype(np.int8)[event],
        int(np.bitwise_count(bits[~known]).sum()),
    )


def decode_dat(words: NDArray) -> Columns:
    """Returns the events of words [M] of DAT 2: 32 bits of time; 14 of column, 14 of row, 1 of polarity."""
    pixel = words["pixel"]
    t = running_clock(words["t"], 1 << 32, 1)
    return Columns(t, pixel & 0x3FFF, pixel >> 14 & 0x3FFF, (pixel >> 28 & 1).astype(np.int8))


EVT2 = Words(np.dtype("<u4"), decode_evt2)
EVT3 = Words(np.dtype("<u2"), decode_evt3)
DAT = Words(np.dtype([("t", "<u4"), ("pixel", "<u4")]), decode_dat)


def _latest(places: NDArray, at: NDArray) -> NDArray[np.int64]:
    """Returns, for each of `at` [N], the index of the last of `places` [K] before it, -1 where there is none."""
    return np.searchsorted(places, at) - 1


def _take_or_first(values: NDArray, index: NDArray) -> NDArray:
    """Returns values [K] at an index [N]; where it is -1, the first, or 0 if there are none."""
    return (values if len(values) else np.zeros(1, values.dtype))[np.maximum(index, 0)]
