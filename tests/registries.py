"""Registries that a test may add to: what it registers is gone after it."""

from __future__ import annotations

import pytest

from edqn_jax.config.registry import AIRFRAMES, FAMILIES, LEARNERS, NETWORKS, SENSORS, SHAPES, Registry

EVERY: tuple[Registry, ...] = (SENSORS, FAMILIES, LEARNERS, NETWORKS, SHAPES, AIRFRAMES)


def keep_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes every registry forget, at the end of the test, what is registered from now on."""
    for registry in EVERY:
        for table in ("_entries", "_about"):
            monkeypatch.setattr(registry, table, dict(getattr(registry, table)))
