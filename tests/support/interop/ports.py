"""UDP ports of the loopback for links under test."""

from __future__ import annotations

from edqn_jax.fly.simulated.ports import hold_udp_port


def free_port() -> int:
    """Returns a UDP port that nobody uses."""
    port, let_go = hold_udp_port()
    let_go()
    return port
