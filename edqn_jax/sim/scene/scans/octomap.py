"""OctoMap's binary maps (.bt): which voxels of a map are occupied.

After a few lines of text each inner node of the tree has two bytes, depth first: two bits for each of its eight
children, 1 of a free one, 2 of an occupied one, 3 of one that has children, 0 of an unknown one.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError

MOST_BYTES = 10_000_000
"""Of a map."""

MOST_VOXELS = 5_000_000
"""Occupied ones of a map."""

_DEPTH = 16  # of a tree, which has so many voxels along each axis as two to the power of it
_BEGINS = b"# Octomap OcTree binary file"
_OCCUPIED, _INNER = 2, 3


def read_octomap(file: Path) -> tuple[NDArray[np.float64], float]:
    """Returns the centres [P, 3] of the occupied voxels of a map, and the length of their sides, in its own units.

    Raises:
        ConfigError: if the file cannot be read, is none of OctoMap's, or has too many voxels.
    """
    try:
        size = file.stat().st_size
        if size > MOST_BYTES:
            raise ConfigError(f"'{file}' has {size:,} bytes; a map may have {MOST_BYTES:,}, so give a part of it")
        content = file.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read the map '{file}': {error.strerror}") from None
    side, body = _resolution(file, content)
    leaves = np.array(_occupied_leaves(file, np.frombuffer(body[: len(body) // 2 * 2], "<u2").tolist()), np.int64)
    leaves = leaves.reshape(-1, 4)
    count = int(np.sum(leaves[:, 3].astype(np.float64) ** 3))
    if count > MOST_VOXELS:
        raise ConfigError(f"'{file}' has {count:,} occupied voxels; it may have {MOST_VOXELS:,}, so give a part of it")
    parts = [np.zeros((0, 3), np.int64)]
    for edge in np.unique(leaves[:, 3]):
        within = np.indices((edge, edge, edge)).reshape(3, -1).T
        parts.append((leaves[leaves[:, 3] == edge, None, :3] + within).reshape(-1, 3))
    return side * (np.concatenate(parts).astype(np.float64) + 0.5 - 2 ** (_DEPTH - 1)), side


def _resolution(file: Path, content: bytes) -> tuple[float, bytes]:
    """Returns the side of a voxel, as a file's text has it, and what follows the text.

    Raises:
        ConfigError: if it is no binary map.
    """
    text, found, body = content.partition(b"\ndata\n")
    if not content.startswith(_BEGINS) or not found:
        raise ConfigError(f"'{file}' is no binary map of OctoMap; it must begin with '{_BEGINS.decode()}'")
    lines = [line.split() for line in text.decode("latin-1").splitlines() if not line.startswith("#")]
    words = {line[0]: line[1] for line in lines if len(line) == 2}
    try:
        side = float(words.get("res", ""))
    except ValueError:
        side = 0.0
    if words.get("id") != "OcTree" or not 0 < side < np.inf:
        raise ConfigError(f"'{file}' must have the lines 'id OcTree' and 'res' with the metres of a voxel's side")
    return side, body


def _occupied_leaves(file: Path, codes: list[int]) -> list[tuple[int, int, int, int]]:
    """Returns the lowest voxel of each occupied leaf, and how many voxels it has along each axis.

    Raises:
        ConfigError: if the tree is cut off, or deeper than OctoMap's.
    """
    leaves, pending, number = [], [(0, 0, 0, 1 << _DEPTH)], 0
    while pending and codes:
        x, y, z, edge = pending.pop()
        edge //= 2
        if number == len(codes) or edge == 0:
            raise ConfigError(f"the map '{file}' is damaged: its tree {'is cut off' if edge else 'is too deep'}")
        code, number = codes[number], number + 1
        for child in range(7, -1, -1):  # the first one is popped first
            kind = code >> 2 * child & 3
            if kind in (_OCCUPIED, _INNER):
                place = (x + edge * (child & 1), y + edge * (child >> 1 & 1), z + edge * (child >> 2), edge)
                (leaves if kind == _OCCUPIED else pending).append(place)
    return leaves
