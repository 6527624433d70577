"""Options that this version no longer has, which configurations of older versions still name."""

from __future__ import annotations

from typing import Any

LAST_COMMIT = "e3f1c6b"
"""The last one that has these options (docs/ablation.md)."""

RETIRED: dict[str, tuple[Any, ...]] = {
    "encoder.pooling": ("sum",),
    "encoder.sequence_decisions": (1,),
    "agent.munchausen": (0, 0.0),
    "agent.munchausen_temperature": (),
}
"""Values that leave an option off, as it now always is; any value of one that had no effect of its own."""


def is_off(name: str, value: Any) -> bool:
    """Returns whether a retired option has a value with which nothing changes."""
    off = RETIRED[name]
    return not off or value in off
