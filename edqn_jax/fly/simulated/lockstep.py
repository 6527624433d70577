"""A simulated clock that several processes share: none runs ahead of another, however busy the machine is.

Each member tells until when it sleeps; once all sleep, the one that is to wake first goes on, alone. So a flight is the
same on a slow machine as on a fast one, and in a loopback's sockets all is there that was sent before.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from edqn_jax.errors import ConfigError

SLEEP = struct.Struct("<d")
GRANT = struct.Struct("<dq")

WORK_S = 0.005
"""Simulated seconds that a decision takes."""

START_S = 120.0
"""Longest that a member takes to start, or to answer; the machine's seconds."""


class SimulatedClock:
    """A member's clock; `Clock` of `edqn_jax.fly.clocks`."""

    passes = False

    def __init__(self, address: str, name: str) -> None:
        """Joins the clock at `HOST:PORT` under a name of one word.

        Raises:
            ConfigError: if there is none.
        """
        host, _, port = address.rpartition(":")
        try:
            self._socket = socket.create_connection((host, int(port)), START_S)
        except (OSError, ValueError) as error:
            raise ConfigError(f"there is no simulated clock at '{address}': {error}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.sendall(name.encode() + b"\n")
        self._now = 0.0
        self.streamed_us = -1
        """Up to which time of its own clock the camera has sent packets; -1 before the first."""
        self.told = b""
        """What the clock's keeper is told with the next sleep."""

    def now(self) -> float:
        """Returns simulated seconds."""
        return self._now

    def sleep_until(self, moment: float) -> None:
        """Returns once all others have come to this moment.

        Raises:
            ConnectionError: if the simulation has ended.
        """
        self._socket.sendall(SLEEP.pack(max(moment, self._now)) + struct.pack("<i", len(self.told)) + self.told)
        self.told = b""
        self._now, self.streamed_us = GRANT.unpack(_read(self._socket, GRANT.size))

    def work(self) -> None:
        """Lets the time pass that a decision takes."""
        self.sleep_until(self._now + WORK_S)

    def close(self) -> None:
        """Leaves the others to go on."""
        self._socket.close()


class Keeper:
    """Whoever wakes the members, at most at `speed` simulated seconds a second."""

    def __init__(self, speed: float = np.inf) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._server.getsockname()[1]}"
        self._members: dict[str, socket.socket] = {}
        self._wakes: dict[str, float] = {}
        self._speed, self._began = speed, time.monotonic()
        self.now = 0.0

    def admit(self, names: set[str], is_alive: Callable[[], bool]) -> None:
        """Waits until these have joined.

        Raises:
            ConfigError: if one does not, or `is_alive` says that it cannot any more.
        """
        until = time.monotonic() + START_S
        self._server.settimeout(0.2)
        while names - self._members.keys():
            with contextlib.suppress(TimeoutError):
                member, _ = self._server.accept()
                member.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                member.settimeout(START_S)
                self._members[_line(member)] = member
            if time.monotonic() > until or not is_alive():
                missing = ", ".join(sorted(names - self._members.keys()))
                raise ConfigError(f"the simulation cannot begin: {missing} did not start")
        self._began = time.monotonic()

    def collect(self) -> dict[str, bytes]:
        """Waits until all members sleep, and returns what they told; one that has left is forgotten."""
        told = {}
        for name in [name for name in self._members if name not in self._wakes]:
            try:
                (wake,) = SLEEP.unpack(_read(self._members[name], SLEEP.size))
                (size,) = struct.unpack("<i", _read(self._members[name], 4))
                told[name] = _read(self._members[name], size)
                self._wakes[name] = wake
            except (ConnectionError, TimeoutError):
                self._members.pop(name).close()
        return told

    def members(self) -> set[str]:
        """Returns who is there."""
        return set(self._members)

    def next_wake(self) -> float:
        """Returns when the first of the sleeping members wakes."""
        return min(self._wakes.values(), default=np.inf)

    def pass_time(self, moment: float) -> None:
        """Goes on to a moment, not faster than `speed`."""
        self.now = max(self.now, moment)
        if np.isfinite(self._speed):
            left = self.now / self._speed - (time.monotonic() - self._began)
            if left > 0.0:
                time.sleep(left)

    def wake_first(self, streamed_us: int) -> None:
        """Wakes the member whose time is first; of several the first by name."""
        name = min(self._wakes, key=lambda each: (self._wakes[each], each))
        self.pass_time(self._wakes[name])
        with contextlib.suppress(OSError):
            self._members[name].sendall(GRANT.pack(self._wakes.pop(name), streamed_us))

    def close(self) -> None:
        """Ends the simulation for all members."""
        for member in self._members.values():
            member.close()
        self._server.close()


def _line(member: Any) -> str:
    word = b""
    while not word.endswith(b"\n"):
        word += _read(member, 1)
    return word.decode().strip()


def _read(source: socket.socket, size: int) -> bytes:
    parts = b""
    while len(parts) < size:
        part = source.recv(size - len(parts))
        if not part:
            raise ConnectionError("the simulation has ended")
        parts += part
    return parts
