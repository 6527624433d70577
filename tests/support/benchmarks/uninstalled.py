"""Packages hidden, as if they were not installed."""

from __future__ import annotations

import sys

import pytest


def hide(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    """Hides these packages, and our modules that import them, until the test ends."""
    for module in list(sys.modules):
        name = module.split(".")
        ours = name[0] == "conventional_stack" or name[:2] == ["rivals", "planners"] and name[-1] in _NEED_BENCH
        if name[0] in packages or ours:
            monkeypatch.delitem(sys.modules, module)
    for package in packages:
        monkeypatch.setitem(sys.modules, package, None)


_NEED_BENCH = {"astar_compiled", "potential_field", "sampling", "solids"}
