"""OctoMap's maps: which voxels are occupied, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.scans import octomap
from edqn_jax.sim.scene.scans.octomap import read_octomap
from tests.support.octomaps import octomap_of

VOXELS = np.concatenate(
    [
        np.random.default_rng(0).integers(-40, 60, (300, 3)),
        np.indices((8, 8, 8)).reshape(3, -1).T + [16, 0, -8],  # one leaf
    ]
)


def test_occupied_voxels_are_found_whole_leaves_included(tmp_path: Path) -> None:
    (tmp_path / "a.bt").write_bytes(octomap_of(VOXELS, 0.25))
    centres, side = read_octomap(tmp_path / "a.bt")
    assert side == 0.25
    found = centres / side - 0.5
    assert len(found) == len(np.unique(VOXELS, axis=0))
    np.testing.assert_array_equal(np.unique(found, axis=0), np.unique(VOXELS, axis=0))


WHOLE = octomap_of(VOXELS, 0.25)
BAD = {
    "text": (b"ply\n", "is no binary map of OctoMap; it must begin with '# Octomap OcTree binary file'"),
    "full": (WHOLE.replace(b"binary file", b"file"), "is no binary map of OctoMap"),
    "colour": (WHOLE.replace(b"id OcTree", b"id ColorOcTree"), "must have the lines 'id OcTree' and 'res'"),
    "side": (WHOLE.replace(b"res 0.25", b"res nan"), "must have the lines 'id OcTree' and 'res'"),
    "short": (WHOLE[:-10], "is damaged: its tree is cut off"),
    "deep": (WHOLE.partition(b"\ndata\n")[0] + b"\ndata\n" + b"\xff\xff" * 40, "is damaged: its tree is too deep"),
    "large": (octomap_of(np.indices((32, 32, 32)).reshape(3, -1).T, 0.1), "has 32,768 occupied voxels; it may have"),
}


@pytest.mark.parametrize(("content", "says"), BAD.values(), ids=BAD)
def test_what_is_no_map_is_refused(content: bytes, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(octomap, "MOST_VOXELS", 20_000)
    (tmp_path / "a.bt").write_bytes(content)
    with pytest.raises(ConfigError, match=says):
        read_octomap(tmp_path / "a.bt")
    monkeypatch.setattr(octomap, "MOST_BYTES", 3)
    with pytest.raises(ConfigError, match="a map may have 3, so give a part of it"):
        read_octomap(tmp_path / "a.bt")


def test_an_empty_map_has_no_voxels(tmp_path: Path) -> None:
    (tmp_path / "a.bt").write_bytes(octomap_of(VOXELS, 0.25).partition(b"\ndata\n")[0] + b"\ndata\n")
    assert read_octomap(tmp_path / "a.bt")[0].shape == (0, 3)
