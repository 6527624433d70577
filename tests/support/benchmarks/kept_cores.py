"""Stands in for the cores of a process."""

from __future__ import annotations

import os

import pytest


def give_cores(monkeypatch: pytest.MonkeyPatch, *cores: int) -> list[set[int]]:
    """Lets a process have these cores; the list that is returned gets those that it keeps to, each time."""
    kept_to: list[set[int]] = []
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, chosen: kept_to.append(chosen), raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(cores), raising=False)
    return kept_to
