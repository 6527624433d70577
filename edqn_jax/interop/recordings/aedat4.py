"""Recordings in iniVation's AEDAT4: packets of several streams, each compressed by itself.

    #!AER-DAT4.0, CR, LF
    flatbuffer with its length before it: compression, place of the table at the end, description of the streams in XML
    packets: stream int32, length int32, flatbuffer (compressed) with its length before it, of events of 16 bytes

A packet of pictures holds one, with begin and end of its exposure.

Times are read as they stand, in the file's order: faery moves a time that runs back to the one before it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.interop.recordings.recording import Pictures, Recording, recording_of

MAGIC = b"#!AER-DAT4.0\r\n"

EVENT = np.dtype(
    {"names": ["t", "x", "y", "p"], "formats": ["<i8", "<i2", "<i2", "?"], "offsets": [0, 8, 10, 12], "itemsize": 16}
)


EVENTS, PICTURES = "EVTS", "FRME"
"""Kinds of streams that are read."""

CHANNELS = {0: 1, 16: 3, 24: 4}
"""Of a picture of 8 bits, by its format: grey, BGR, BGRA, as OpenCV numbers them."""

BGR = np.array([0.114, 0.587, 0.299])
"""Weights of the paper's Eq. 1."""


class Stream(NamedTuple):
    """A stream of a file."""

    number: int
    kind: str
    name: str
    source: str
    """Name of the camera."""
    size: tuple[int, int] | None
    """Width and height of its image; None where the file does not say them."""


def read_aedat4(file: Path, size: tuple[int, int] | None = None, number: int | None = None) -> Recording:
    """Returns the recording of an AEDAT4, with the pictures of the same camera.

    Args:
        file: to read.
        size: width and height where the file does not say them.
        number: of the stream; None where there is one of events.

    Raises:
        ConfigError: if it is damaged, or has no such stream, or several and `number` is None.
        MissingPackageError: if what unpacks it is not installed.
    """
    content = file.read_bytes()
    if not content.startswith(MAGIC):
        raise ConfigError(f"'{file}' does not begin as an AEDAT4 does: it is damaged, or of another kind")
    try:
        compression, end, streams, begin = _header(content)
        stream = _select_stream(file, [each for each in streams if each.kind == EVENTS], number)
        decompress = _decompressor(file, compression)
        packets = [_events(decompress(packet)) for packet in _packets(content, begin, end, stream.number)]
        taken = [
            packet
            for each in streams
            if each.kind == PICTURES and each.source == stream.source
            for packet in _packets(content, begin, end, each.number)
        ]
        pictures = _pictures_of(taken, decompress)
    except (struct.error, ValueError, ElementTree.ParseError, RuntimeError, MemoryError, KeyError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"'{file}' is damaged: {error}") from None
    events = np.concatenate(packets) if packets else np.zeros(0, EVENT)
    return recording_of(
        str(file),
        t=events["t"],
        x=events["x"],
        y=events["y"],
        p=events["p"],
        size=stream.size or size,
        time_unit="us",
        says_unit="us, as AEDAT4 has it",
        pictures=pictures,
    )


def _pictures_of(packets: list[bytes], decompress: Callable[[bytes], bytes]) -> Pictures | None:
    """Returns pictures of 8 bits in the order of their times, unpacked when they are asked for; None without any."""
    ends = {number: _end_of_exposure(decompress(packet)) for number, packet in enumerate(packets)}
    known = sorted((end, number) for number, end in ends.items() if end is not None)
    if not known:
        return None
    times = np.array([end for end, _ in known], np.int64)
    return Pictures(times, lambda place: _picture(decompress(packets[known[place][1]])))


def _header(content: bytes) -> tuple[int, int, list[Stream], int]:
    """Returns compression, where packets end, the streams and where packets begin."""
    at = len(MAGIC)
    begin = at + 4 + struct.unpack_from("<I", content, at)[0]
    root = at + 4 + struct.unpack_from("<I", content, at + 4)[0]
    compression = _field(content, root, 0, "<i", 0)
    end = _field(content, root, 1, "<q", -1)
    text = root + _offset(content, root, 2)
    text += struct.unpack_from("<I", content, text)[0]
    length = struct.unpack_from("<I", content, text)[0]
    described = ElementTree.fromstring(content[text + 4 : text + 4 + length].decode("utf-8").rstrip("\0"))
    return compression, len(content) if end < 0 else end, _streams(described), begin


def _streams(described: ElementTree.Element) -> list[Stream]:
    found = []
    for node in described.iterfind("node[@name='outInfo']/node"):
        said = {attribute.get("key"): attribute.text or "" for attribute in node.iter("attr")}
        kind, name, source = (said.get(key, "") for key in ("typeIdentifier", "originalOutputName", "source"))
        if kind in (EVENTS, PICTURES):
            sides = said.get("sizeX"), said.get("sizeY")
            size = (int(sides[0]), int(sides[1])) if sides[0] and sides[1] else None
            found.append(Stream(int(node.attrib["name"]), kind, name, source, size))
    return found


def _select_stream(file: Path, streams: list[Stream], number: int | None) -> Stream:
    """Returns the stream of a number, or the only one.

    Raises:
        ConfigError: if there is none, or several and the number is None.
    """
    if not streams:
        raise ConfigError(f"'{file}' has no stream of events")
    known = ", ".join(f"{stream.number} '{stream.name}'" for stream in streams)
    if number is None and len(streams) > 1:
        raise ConfigError(f"'{file}' has {len(streams)} streams of events, {known}; give --stream")
    for stream in streams:
        if number in (None, stream.number):
            return stream
    raise ConfigError(f"'{file}' has no stream of events {number}; it has {known}")


def _packets(content: bytes, begin: int, end: int, number: int) -> list[bytes]:
    """Returns the packets of a stream, as they are packed.

    Raises:
        ValueError: if the last one ends within.
    """
    found = []
    while begin < end:
        stream, length = struct.unpack_from("<ii", content, begin)
        begin += 8 + length
        if length < 0 or begin > len(content):
            raise ValueError("it ends within a packet, as a file does that was cut off")
        if stream == number:
            found.append(content[begin - length : begin])
    return found


def _decompressor(file: Path, compression: int) -> Callable[[bytes], bytes]:
    """Returns what unpacks a packet: 0 nothing, 1 and 2 LZ4, 3 and 4 Zstandard.

    Raises:
        ConfigError: if the compression is another.
        MissingPackageError: if its package is not installed.
    """
    if compression == 0:
        return bytes
    if compression in (1, 2):
        return require_extra("lz4.frame", extra="events").decompress
    if compression in (3, 4):
        zstandard = require_extra("zstandard", extra="events")

        def unpack(packet: bytes) -> bytes:
            try:
                return zstandard.ZstdDecompressor().decompressobj().decompress(packet)
            except zstandard.ZstdError as error:
                raise ValueError(str(error)) from None

        return unpack
    raise ConfigError(f"'{file}' is compressed in a way, {compression}, that is not read")


def _events(packet: bytes) -> NDArray:
    """Returns the events [N] of an unpacked packet.

    Raises:
        ValueError: if it holds no events.
    """
    root = 4 + struct.unpack_from("<I", packet, 4)[0]
    if packet[8:12] != b"EVTS":
        raise ValueError("a packet of its stream of events holds something else")
    place = _offset(packet, root, 0)
    if not place:
        return np.zeros(0, EVENT)
    vector = root + place
    vector += struct.unpack_from("<I", packet, vector)[0]
    number = struct.unpack_from("<I", packet, vector)[0]
    return np.frombuffer(packet, EVENT, number, vector + 4)


def _end_of_exposure(packet: bytes) -> int | None:
    """Returns the end of the exposure, µs, of an unpacked packet's picture; None of one that is not of 8 bits.

    Raises:
        ValueError: if it holds no picture.
    """
    root = 4 + struct.unpack_from("<I", packet, 4)[0]
    if packet[8:12] != b"FRME":
        raise ValueError("a packet of its stream of pictures holds something else")
    if _field(packet, root, 5, "<b", 0) not in CHANNELS:
        return None
    return _field(packet, root, 4, "<q", 0) or _field(packet, root, 0, "<q", 0)


def _picture(packet: bytes) -> NDArray[np.uint8]:
    """Returns the picture [H, W] of an unpacked packet, one of 8 bits."""
    root = 4 + struct.unpack_from("<I", packet, 4)[0]
    form, width, height = (_field(packet, root, *each, 0) for each in ((5, "<b"), (6, "<h"), (7, "<h")))
    vector = root + _offset(packet, root, 10)
    vector += struct.unpack_from("<I", packet, vector)[0]
    size = height, width, CHANNELS[form]
    pixels = np.frombuffer(packet, np.uint8, height * width * size[2], vector + 4).reshape(size)
    return pixels[..., 0] if form == 0 else np.rint(pixels[..., :3] @ BGR).astype(np.uint8)


def _offset(buffer: bytes, table: int, field: int) -> int:
    """Returns where a field of a flatbuffer's table is, bytes after the table; 0 where it is not written."""
    entries = table - struct.unpack_from("<i", buffer, table)[0]
    length = struct.unpack_from("<H", buffer, entries)[0]
    at = 4 + 2 * field
    return struct.unpack_from("<H", buffer, entries + at)[0] if at < length else 0


def _field(buffer: bytes, table: int, field: int, form: str, default: int) -> int:
    place = _offset(buffer, table, field)
    return struct.unpack_from(form, buffer, table + place)[0] if place else default
