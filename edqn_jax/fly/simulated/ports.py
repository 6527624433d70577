"""Free UDP ports for simulated flights."""

from __future__ import annotations

import socket
from collections.abc import Callable


def hold_udp_port() -> tuple[int, Callable[[], None]]:
    """Returns a free UDP port of the loopback, and what lets it go.

    Until then no one else is given it, and a link can be bound to it.
    """
    held = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    held.bind(("127.0.0.1", 0))
    held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as pymavlink's, which binds beside it
    return held.getsockname()[1], held.close
