"""Writes OctoMap's binary maps, in other words than `sim/scene/scans/octomap.py` reads them in."""

from __future__ import annotations

import numpy as np

UNKNOWN, OCCUPIED, INNER = "00", "01", "11"


def octomap_of(voxels: np.ndarray, side: float) -> bytes:
    """Returns the file of a map of occupied voxels [P, 3], whole numbers about the middle of the tree; full ones are
    pruned."""
    words: list[str] = []
    _add(np.unique(np.asarray(voxels) + 2**15, axis=0), 16, words)
    data = bytes(int(word[i : i + 8][::-1], 2) for word in words for i in (0, 8))
    text = f"# Octomap OcTree binary file\n# of a test\nid OcTree\nsize {len(words)}\nres {side}\ndata\n"
    return text.encode() + data


def _add(voxels: np.ndarray, depth: int, words: list[str]) -> None:
    """Adds an inner node that spans two to the power of `depth` voxels, and those below it."""
    half = 2 ** (depth - 1)
    child = (voxels // half) @ [1, 2, 4]
    of = [voxels[child == number] % half for number in range(8)]
    kinds = [UNKNOWN if not len(each) else OCCUPIED if len(each) == half**3 else INNER for each in of]
    words.append("".join(kinds))
    for each, kind in zip(of, kinds, strict=True):
        if kind == INNER:
            _add(each, depth - 1, words)
