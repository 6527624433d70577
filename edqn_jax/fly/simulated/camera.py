"""An event camera that sees a simulated world, with a clock of its own, and streams what it saw."""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edqn_jax.fly.simulated.esim import Esim
from edqn_jax.fly.streams import EVENT, HEADER, MAGIC, packet_bytes
from edqn_jax.interop.outer.event_cameras import CONTRAST
from edqn_jax.interop.outer.pictures import See

AHEAD_S, FAST = 77.7, 1e-5
"""Of the camera's clock against the simulation's."""


class EventCamera:
    """ESIM on pictures of a world, frame by frame."""

    def __init__(self, see: See, rotation: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> None:
        """Prepares a camera.

        Args:
            see: draws a picture from a position [3] and a rotation [3, 3].
            rotation: of the camera, for an attitude [4] of the body.
        """
        self._see, self._rotation, self._esim = see, rotation, Esim(CONTRAST)
        self.seen = 0
        """Events so far."""

    def frame(
        self, time: float, position: NDArray[np.float64], quaternion: NDArray[np.float64], light: float = 1.0
    ) -> tuple[int, NDArray]:
        """Returns until when its events are known, its own clock's microseconds, and those [N] since the last frame.

        Args:
            time: simulated seconds.
            position: [3] metres.
            quaternion: [4] of the body.
            light: share of it that comes through the lens.
        """
        own_s = AHEAD_S + time * (1.0 + FAST)
        columns, rows, signs = self._esim.events(light * self._see(position, self._rotation(quaternion)))
        self.seen += len(signs)
        until = round(1e6 * own_s)
        events = np.empty(len(signs), EVENT)
        events["x"], events["y"], events["p"] = columns, rows, signs
        # ESIM gives them the frame's time, which is the end of what they tell of.
        events["t"] = until - 1
        return until, events


class EventServer:
    """Streams packets to whoever connects first; a thread writes, so that nobody waits for a full socket."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._server.getsockname()[1]}"
        self._packets: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._packets.put(HEADER.pack(MAGIC, *size))
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def send(self, until_us: int, events: NDArray) -> None:
        """Sends a packet of events [N]."""
        self._packets.put(packet_bytes(until_us, events))

    def close(self) -> None:
        """Ends the stream."""
        self._packets.put(None)
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self._thread.join(timeout=2.0)

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            client: Any
            client, _ = self._server.accept()
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with client:
                while (packet := self._packets.get()) is not None:
                    client.sendall(packet)
