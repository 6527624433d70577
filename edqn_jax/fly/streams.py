"""Events as they come: over a socket, from dv-processing, or from a recording that is played at its own speed.

The stream of a socket, and of a flight's log: `EVS1`, width and height (uint16), then packets of int64 `until`, uint32
N and N events of `EVENT`, all little-endian. A packet holds all events before `until`, microseconds of the camera's
clock, that no earlier one held; one without events says that there were none.
"""

from __future__ import annotations

import collections
import contextlib
import select
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.fly.clocks import ClockOffset

EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
MAGIC = b"EVS1"
HEADER = struct.Struct("<4sHH")
PACKET = struct.Struct("<qI")

RATE_S = 0.1
"""The rate of events is counted over so long."""

DARKENING_S = 0.2
"""Likewise how much darker the picture has become."""

START_S = 5.0
"""Longest that a camera takes to answer."""

CHUNK = 1 << 20

POLL_S = 0.0005
"""Between two looks at a camera that cannot be waited for."""


class Events:
    """The newest events of a camera."""

    def __init__(self, size: tuple[int, int] | None = None, keep_us: int = 1_000_000) -> None:
        self.size = size
        """Width and height that the camera says it has; None before it has said so."""
        self.until_us = -1
        """Up to when its events are known, on its clock."""
        self.packet_at: float | None = None
        """When the newest packet came, on the host's clock."""
        self.offset = ClockOffset()
        """Of the camera's clock."""
        self._keep_us = keep_us
        self._packets: collections.deque[tuple[float, int, NDArray]] = collections.deque()
        self._darkenings: collections.deque[tuple[float, int]] = collections.deque()

    def add(self, events: NDArray, until_us: int, at: float) -> None:
        """Takes a packet of events [N] that came at a time of the host's clock."""
        if events.size and self.size is not None:
            needed = int(events["x"].max()) + 1, int(events["y"].max()) + 1
            if needed[0] > self.size[0] or needed[1] > self.size[1]:
                self.size = max(needed[0], self.size[0]), max(needed[1], self.size[1])
        if until_us < self.until_us:  # the camera's clock began anew
            self._packets.clear()
        self.until_us, self.packet_at = until_us, at
        self._darkenings.append((at, events.size - 2 * int(np.count_nonzero(events["p"] > 0))))
        while self._darkenings[0][0] <= at - DARKENING_S:
            self._darkenings.popleft()
        self.offset.add_arrival(1e-6 * until_us, at)
        self._packets.append((at, until_us, events))
        while self._packets[0][1] < until_us - self._keep_us:
            self._packets.popleft()

    def next_at(self) -> float | None:
        """Returns when the next packet is to be expected, on the host's clock; None before two have come."""
        if len(self._packets) < 2 or self.offset.value is None:
            return None
        (_, before, _), (_, newest, _) = self._packets[-2], self._packets[-1]
        return self.offset.value + 1e-6 * (2 * newest - before)

    def window(self, since_us: int, until_us: int) -> NDArray:
        """Returns the events [N] of `EVENT` from `since` to before `until`, microseconds of the camera's clock."""
        held, begin = [np.empty(0, EVENT)], -1
        for _, end, events in self._packets:
            if end > since_us and begin < until_us:
                whole = begin >= since_us and end <= until_us
                held.append(events if whole else events[(events["t"] >= since_us) & (events["t"] < until_us)])
            begin = end
        return np.concatenate(held)

    def since(self, until_us: int) -> list[tuple[int, NDArray]]:
        """Returns `until` and events [N] of the packets after that which ended at `until_us`."""
        return [(end, events) for _, end, events in self._packets if end > until_us]

    def rate_hz(self, now: float) -> float:
        """Returns events per second of those that came in the last tenth of a second."""
        return sum(each.size for at, _, each in self._packets if at > now - RATE_S) / RATE_S

    def darkening(self, now: float) -> float:
        """Returns by how many OFF events, less ON ones, a pixel has become darker in the last fifth of a second."""
        if self.size is None:
            return 0.0
        net = sum(net for at, net in self._darkenings if at > now - DARKENING_S)
        return net / (self.size[0] * self.size[1])


class EventSource(Protocol):
    """Where events come from."""

    events: Events

    def read(self, now: float, least_us: int = -1) -> None:
        """Takes what has come; waits until it is known up to `least_us`, if the camera has sent that."""
        ...

    def wait(self, most_s: float) -> None:
        """Returns once something has come that was not read, or after so many seconds of the machine."""
        ...

    def close(self) -> None:
        """Lets the camera go."""
        ...


class Decoder:
    """From bytes of a stream to packets, in whatever pieces they come."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.size: tuple[int, int] | None = None

    def feed(self, data: bytes) -> Iterator[tuple[int, NDArray]]:
        """Yields `until` and events [N] of each packet that is whole now.

        Raises:
            ConfigError: if the bytes are no stream of events.
        """
        self._bytes += data
        if self.size is None:
            if len(self._bytes) < HEADER.size:
                return
            magic, width, height = HEADER.unpack_from(self._bytes)
            if magic != MAGIC:
                raise ConfigError("what comes there is no stream of events: it does not begin with EVS1")
            self.size = width, height
            del self._bytes[: HEADER.size]
        place = 0
        while len(self._bytes) - place >= PACKET.size:
            until, count = PACKET.unpack_from(self._bytes, place)
            end = place + PACKET.size + count * EVENT.itemsize
            if len(self._bytes) < end:
                break
            yield until, np.frombuffer(bytes(self._bytes[place + PACKET.size : end]), EVENT)
            place = end
        del self._bytes[:place]


def packet_bytes(until_us: int, events: NDArray) -> bytes:
    """Returns a packet of the stream, of events [N]."""
    return PACKET.pack(until_us, events.size) + np.ascontiguousarray(events.astype(EVENT, copy=False)).tobytes()


class SocketStream:
    """A camera at `HOST:PORT` that sends the stream of this module."""

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        try:
            self._socket = socket.create_connection((host, int(port)), START_S)
        except (OSError, ValueError) as error:
            raise ConfigError(f"there is no camera at '{address}' ({error}); write it as tcp:HOST:PORT") from error
        self._decoder, self.events, self._has_ended = Decoder(), Events(), False
        try:
            self._read_header(address)
        except ConfigError:
            self._socket.close()
            raise

    def _read_header(self, address: str) -> None:
        """Waits for the size of the camera's image."""
        self._socket.settimeout(START_S)
        while self._decoder.size is None:
            data = b""
            with contextlib.suppress(OSError):
                data = self._socket.recv(HEADER.size)
            if not data:
                raise ConfigError(f"the camera at '{address}' says nothing; is it another program's port?")
            list(self._decoder.feed(data))
        self.events.size = self._decoder.size

    def read(self, now: float, least_us: int = -1) -> None:
        """Takes what has come."""
        while True:
            self._socket.settimeout(START_S if self.events.until_us < least_us else 0.0)
            try:
                data = self._socket.recv(CHUNK)
            except (BlockingIOError, TimeoutError, ConnectionError):
                return
            if not data:
                self._has_ended = True
                return
            for until, events in self._decoder.feed(data):
                self.events.add(events, until, now)

    def wait(self, most_s: float) -> None:
        """Returns once something has come, or after so many seconds."""
        if self._has_ended:  # its end could be read again and again
            time.sleep(most_s)
        else:
            select.select([self._socket], [], [], most_s)

    def close(self) -> None:
        """Closes the connection."""
        self._socket.close()


class DvStream:
    """A camera behind dv-processing's network writer at `HOST:PORT`, as of a DVXplorer or a DAVIS."""

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        reader = require_extra("dv_processing", extra="fly").io.NetworkReader
        try:
            self._reader: Any = reader(host, int(port))
            size = self._reader.getEventResolution()
        except (RuntimeError, ValueError) as error:
            raise ConfigError(f"there is no stream of dv-processing at '{address}': {error}") from error
        if size is None:
            raise ConfigError(f"the stream of dv-processing at '{address}' has no events")
        self.events = Events((int(size[0]), int(size[1])))

    def read(self, now: float, least_us: int = -1) -> None:
        """Takes what has come; its packets are never empty, so a still camera without noise seems to be gone."""
        while (batch := self._next()) is not None:
            found = batch.numpy()
            events = np.empty(len(found), EVENT)
            events["t"], events["x"], events["y"] = found["timestamp"], found["x"], found["y"]
            events["p"] = np.where(found["polarity"] > 0, 1, -1)
            if events.size:
                self.events.add(events, int(events["t"].max()) + 1, now)

    def wait(self, most_s: float) -> None:
        """Returns soon: its reader cannot be waited for."""
        time.sleep(min(most_s, POLL_S))

    def _next(self) -> Any:
        """Returns a batch of events; None if none has come, or the stream has ended."""
        with contextlib.suppress(RuntimeError):
            return self._reader.getNextEventBatch()
        return None

    def close(self) -> None:
        """Lets the stream go."""
        self._reader = None


class Recorded:
    """A recording that is played at its own speed from the first `read` on."""

    def __init__(self, events: NDArray, size: tuple[int, int]) -> None:
        self._events, self.events = events, Events(size)
        self._next, self._began = 0, 0.0

    def read(self, now: float, least_us: int = -1) -> None:
        """Takes what has come by now."""
        if self.events.packet_at is None:
            self._began = now
        first = int(self._events["t"][0]) if self._events.size else 0
        until = first + round(1e6 * (now - self._began))
        end = int(np.searchsorted(self._events["t"], until))
        if self._events.size and until > int(self._events["t"][-1]) + 1:
            return
        self.events.add(self._events[self._next : end].astype(EVENT), until, now)
        self._next = end

    def wait(self, most_s: float) -> None:
        """Returns soon: events come as time passes."""
        time.sleep(min(most_s, POLL_S))

    def close(self) -> None:
        """Does nothing."""


def open_events(name: str, size: tuple[int, int] | None = None) -> EventSource:
    """Returns the events of `tcp:HOST:PORT`, `dv:HOST:PORT`, or a file that `edqn events` reads.

    Raises:
        ConfigError: if there is no such camera or file, or the file does not say how large the camera's image is.
        MissingPackageError: if dv-processing, or what a file needs, is not installed.
    """
    kind, _, address = name.partition(":")
    if kind == "tcp":
        return SocketStream(address)
    if kind == "dv":
        return DvStream(address)
    if not Path(name).is_file():
        raise ConfigError(f"'{name}' is no camera and no file; write tcp:HOST:PORT, dv:HOST:PORT or the name of a file")
    # On the ground: reading files needs more of the package, JAX included.
    from edqn_jax.interop.recordings.event_files import read_events

    recording = read_events(Path(name), size=size)
    width, height = recording.width, recording.height
    if width is None or height is None:
        raise ConfigError(f"'{name}' does not say how large the camera's image is; give --camera W H")
    return Recorded(recording.events, (width, height))


def read_stream(file: Path) -> list[tuple[int, NDArray]]:
    """Returns `until` and events [N] of each packet of a stream in a file; a packet that was cut off is left out."""
    decoder = Decoder()
    with contextlib.closing(file.open("rb")) as opened:
        return list(decoder.feed(opened.read()))
