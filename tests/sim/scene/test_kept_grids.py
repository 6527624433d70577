"""Grids of distances that are kept from one command to the next."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edqn_jax.sim.scene import kept_grids
from edqn_jax.sim.scene.kept_grids import kept_values

VALUES = np.arange(24.0).reshape(2, 3, 4)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Names of the grids that were made, in a folder of the test's own."""
    monkeypatch.setattr(kept_grids, "private_folder", lambda: tmp_path)
    return []


def values_of(name: str, made: list[str]) -> np.ndarray:
    def make() -> np.ndarray:
        made.append(name)
        return VALUES

    found = kept_values((name.encode(), b"cell"), make)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, VALUES)
    return found


def test_a_grid_of_the_same_content_is_made_once(made: list[str], tmp_path: Path) -> None:
    for name in ("one", "one", "other", "one"):
        values_of(name, made)
    assert made == ["one", "other"] and len(list(tmp_path.iterdir())) == 2


def test_a_damaged_file_is_made_anew(made: list[str], tmp_path: Path) -> None:
    values_of("one", made)
    [file] = tmp_path.iterdir()
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    for broken in (bytes(content), content[:40], b""):
        file.write_bytes(broken)
        values_of("one", made)
        values_of("one", made)
    assert len(made) == 4


def test_without_a_folder_nothing_is_kept(made: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_grids, "private_folder", lambda: None)
    values_of("one", made)
    values_of("one", made)
    assert made == ["one", "one"]
