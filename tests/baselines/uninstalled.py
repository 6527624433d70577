"""Packages hidden, as if they were not installed."""

from __future__ import annotations

import sys

import pytest


def hide(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    """Until the test ends, neither these packages nor modules of ours that have imported them are there."""
    for module in list(sys.modules):
        name = module.split(".")
        if name[0] in packages or name[:2] == ["edqn_jax", "baselines"] and _NEED_BENCH.intersection(name[2:]):
            monkeypatch.delitem(sys.modules, module)
    for package in packages:
        monkeypatch.setitem(sys.modules, package, None)


_NEED_BENCH = {"astar_compiled", "conventional", "potential_field", "sampling", "solids"}
