"""AEDAT4 written field by field, after its published description; slow and obvious."""

from __future__ import annotations

import struct

import numpy as np

from edqn_jax.extras import require_extra

lz4 = require_extra("lz4.frame", extra="events")
zstandard = require_extra("zstandard", extra="events")

PACKERS = {0: bytes, 1: lz4.compress, 3: zstandard.ZstdCompressor().compress}
"""By the number of the compression: none, LZ4, Zstandard."""


def aedat4(
    packets: list[tuple[int, np.ndarray]], names: list[str], width: int, height: int, compression: int = 1
) -> bytes:
    """Returns a file of these packets (number of the stream, events) in streams of these names."""
    streams = "".join(
        f'<node name="{number}" path="/outInfo/{number}/"><attr key="typeIdentifier" type="string">EVTS</attr>'
        f'<attr key="originalOutputName" type="string">{name}</attr><node name="info"><attr key="sizeX" type="int">'
        f'{width}</attr><attr key="sizeY" type="int">{height}</attr></node></node>'
        for number, name in enumerate(names)
    )
    text = f'<dv version="2.0"><node name="outInfo" path="/outInfo/">{streams}</node></dv>'.encode()
    # Length, root, a table of entries (its size, the size of the table, three fields), the table, and its text.
    vtable = struct.pack("<5H", 10, 24, 4, 8, 16) + bytes(2)
    table = struct.pack("<iiqII", len(vtable), compression, -1, 8, 0)
    body = struct.pack("<I", 4 + len(vtable)) + vtable + table + struct.pack("<I", len(text)) + text + bytes(1)
    parts = [b"#!AER-DAT4.0\r\n", struct.pack("<I", len(body)), body]
    for number, events in packets:
        packed = PACKERS[compression](_packet(events))
        parts += [struct.pack("<ii", number, len(packed)), packed]
    return b"".join(parts)


def _packet(events: np.ndarray) -> bytes:
    rows = b"".join(struct.pack("<qhh?3x", t, x, y, p > 0) for t, x, y, p in events.tolist())
    table = struct.pack("<3H", 6, 8, 4) + bytes(2) + struct.pack("<iI", 8, 4) + struct.pack("<I", len(events)) + rows
    body = struct.pack("<I", 16) + b"EVTS" + table
    return struct.pack("<I", len(body)) + body
