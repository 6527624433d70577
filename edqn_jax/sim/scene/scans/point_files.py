"""Clouds of points: `.xyz`, lines of three numbers, and `.pcd` of the Point Cloud Library, as text or binary.

Counts are looked at before anything is read.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.mjcf_parts.assets import MOST_BYTES

POINT_KINDS = ("xyz", "pcd")
"""Endings of such files."""

_HEADER = 10_000  # bytes that hold the header of a .pcd, or the first lines of an .xyz
_LONGEST = 1000  # bytes of a line of text
_LINES = 2  # for each point, empty ones and comments included
_TYPES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}  # bytes that numbers of a .pcd may have


def read_points(file: Path, kind: str, most: int) -> NDArray[np.float64]:
    """Returns the points [P, 3] of a file, in its own units.

    Args:
        file: to be read.
        kind: of `POINT_KINDS`.
        most: points that it may have.

    Raises:
        ConfigError: if it cannot be read, is not such a file, or has more points.
    """
    try:
        size = file.stat().st_size
        if size > MOST_BYTES:
            raise ConfigError(f"'{file}' has {size / 1e9:.1f} GB; it may have {MOST_BYTES / 1e9:g}, so thin it out")
        content = file.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read '{file}': {error.strerror}") from None
    if not content:
        raise ConfigError(f"'{file}' is empty; a world needs points")
    return _pcd(file, content, most) if kind == "pcd" else _xyz(file, content, most)


def _xyz(file: Path, content: bytes, most: int) -> NDArray[np.float64]:
    lines = (line.partition(b"#")[0].strip() for line in content[:_HEADER].splitlines())
    first = next((line for line in lines if line), b"")
    return _numbers(file, content, most, (0, 1, 2), b"," if b"," in first else None)


def _numbers(
    file: Path, content: bytes, most: int, columns: Sequence[int], between: bytes | None = None
) -> NDArray[np.float64]:
    """Returns three columns [P, 3] of lines of numbers, of which at most `most` may be there."""
    text = f"'{file}' is no list of points: each of its lines must begin with x y z"
    # Before numbers are read: a line that never ends would be read whole.
    if content.count(b"\n") > _LINES * most:
        _check_count(file, most + 1, most)
    ends = np.flatnonzero(np.frombuffer(content, np.uint8) == ord("\n"))
    if np.diff(ends, prepend=-1, append=len(content)).max() > _LONGEST:
        raise ConfigError(text)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of no lines at all
            delimiter = None if between is None else between.decode()
            rows = np.loadtxt(
                io.BytesIO(content), usecols=columns, max_rows=most + 1, delimiter=delimiter, ndmin=2, encoding="latin1"
            )
    except (ValueError, IndexError) as error:
        raise ConfigError(f"{text}; {' '.join(str(error).split())[:150]}") from None
    _check_count(file, len(rows), most)
    return rows.reshape(-1, 3)


def _check_count(file: Path, count: int, most: int) -> None:
    """Raises ConfigError if a file has too many points."""
    if count > most:
        there = "more than that" if count == most + 1 else f"{count:,}"
        raise ConfigError(f"'{file}' may have {most:,} points and has {there}, so thin it out")


def _pcd(file: Path, content: bytes, most: int) -> NDArray[np.float64]:
    words, data = _header_of(file, content)
    how = words["DATA"][0].lower()
    if how == "binary_compressed":
        raise ConfigError(f"'{file}' is compressed; write it as binary, with pcl_convert_pcd_ascii_binary IN OUT 1")
    if how not in ("ascii", "binary"):
        raise ConfigError(f"'{file}' has DATA {how}; it must be ascii or binary")
    row, columns = _row_of(file, words)
    try:
        points = int(words["POINTS"][0]) if "POINTS" in words else int(words["WIDTH"][0]) * int(words["HEIGHT"][0])
    except (KeyError, ValueError):
        raise ConfigError(f"'{file}' does not say how many POINTS it has") from None
    _check_count(file, points, most)
    if how == "ascii":
        found = _numbers(file, data, most, columns)
    else:
        found = np.zeros((0, 3))
        if points >= 0 and len(data) >= points * row.itemsize:
            table = np.frombuffer(data, row, count=points)
            found = np.stack([table[f"f{name}"] for name in "xyz"], axis=1).astype(np.float64)
    if len(found) != points:
        raise ConfigError(f"'{file}' says that it has {points:,} points, and there are others or fewer in it")
    return found


def _header_of(file: Path, content: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Returns the words of a .pcd's header by the first of each line, and what follows it."""
    words: dict[str, list[str]] = {}
    place = 0
    while "DATA" not in words:
        end = content.find(b"\n", place, _HEADER)
        if end < 0:
            raise ConfigError(f"'{file}' is no .pcd: a header from VERSION to DATA must come first")
        line = content[place:end].decode("latin1").partition("#")[0].split()
        place = end + 1
        if len(line) > 1:
            words[line[0].upper()] = line[1:]
    return words, content[place:]


def _row_of(file: Path, words: dict[str, list[str]]) -> tuple[np.dtype, list[int]]:
    """Returns a point of a binary .pcd, with the parts fx, fy and fz, and the columns of x, y and z in text."""
    names = [name.lower() for name in words.get("FIELDS", [])]
    if any(names.count(name) != 1 for name in "xyz"):
        raise ConfigError(f"'{file}' must have the FIELDS x, y and z, each once")
    try:
        sizes, counts = ([int(each) for each in words.get(key, ["1"] * len(names))] for key in ("SIZE", "COUNT"))
        parts = list(zip(names, words.get("TYPE", []), sizes, counts, strict=True))
    except ValueError:
        parts = []
    if not parts or any(size not in _TYPES.get(kind.upper(), ()) or not 0 < n < 10_000 for _, kind, size, n in parts):
        raise ConfigError(f"'{file}' must have a SIZE, a TYPE (F, I or U) and a COUNT for each of its FIELDS")
    if any(n != 1 for name, _, _, n in parts if name in ("x", "y", "z")):
        raise ConfigError(f"'{file}' has several x, y or z for each point; COUNT must be 1")
    # Padding is named _ , several times.
    labels = [f"f{name}" if name in ("x", "y", "z") else f"other {i}" for i, name in enumerate(names)]
    row = np.dtype(
        [(label, f"<{k.lower()}{s}", (n,) if n > 1 else ()) for label, (_, k, s, n) in zip(labels, parts, strict=True)]
    )
    begins = np.cumsum([0, *counts])
    return row, [int(begins[names.index(name)]) for name in "xyz"]
