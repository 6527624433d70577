"""Prophesee's EVT2, EVT3 and DAT written word by word, after their published descriptions; slow and obvious."""

from __future__ import annotations

import struct

import numpy as np

EVT2_OFF, EVT2_ON, EVT2_TIME_HIGH = 0x0, 0x1, 0x8

EVT3_Y, EVT3_X, EVT3_TIME_LOW, EVT3_TIME_HIGH = 0x0, 0x2, 0x6, 0x8


def evt2(events: np.ndarray, width: int, height: int) -> bytes:
    """Returns a `.raw` of EVT 2.0: 32-bit words; a word with the high 28 bits of the time before those that need it."""
    words, high = [], -1
    for t, x, y, p in events.tolist():
        if t >> 6 != high:
            high = t >> 6
            words.append(EVT2_TIME_HIGH << 28 | high)
        kind = EVT2_ON if p > 0 else EVT2_OFF
        words.append(kind << 28 | (t & 63) << 22 | x << 11 | y)
    header = f"% evt 2.0\n% format EVT2;width={width};height={height}\n% geometry {width}x{height}\n% end\n"
    return header.encode() + struct.pack(f"<{len(words)}I", *words)


def evt3(events: np.ndarray, width: int, height: int) -> bytes:
    """Returns a `.raw` of EVT 3.0: 16-bit words for the time, the row and each event's column."""
    words, high, low, row = [], -1, -1, -1
    for t, x, y, p in events.tolist():
        if t >> 12 != high:
            high, low = t >> 12, -1  # Prophesee's decoder begins with lower bits of 0 here
            words.append(EVT3_TIME_HIGH << 12 | high)
        if t & 4095 != low:
            low = t & 4095
            words.append(EVT3_TIME_LOW << 12 | low)
        if y != row:
            row = y
            words.append(EVT3_Y << 12 | y)
        words.append(EVT3_X << 12 | (p > 0) << 11 | x)
    header = f"% evt 3.0\n% format EVT3;height={height};width={width}\n% geometry {width}x{height}\n% end\n"
    return header.encode() + struct.pack(f"<{len(words)}H", *words)


def dat(events: np.ndarray, header: bytes, kind: int = 12) -> bytes:
    """Returns a `.dat`: two bytes of kind and length, then 32 bits of time and 32 of pixel and polarity an event."""
    rows = b"".join(struct.pack("<II", t, x | y << 14 | (p > 0) << 28) for t, x, y, p in events.tolist())
    return header + bytes([kind, 8]) + rows
