"""Recordings as HDF5 in the layout of DSEC (Gehrig et al. 2021). Needs the extra `events`.

    events/x, events/y   uint16 [N]
    events/p             uint8 [N], 0 is OFF
    events/t             uint32 [N] microseconds since t_offset (int64 where it does not fit)
    t_offset             int64 microseconds
    ms_to_idx            uint64 [M]: t[ms_to_idx[k]] is the first event of millisecond k or later

DSEC's own files do not say how large the image is; ours do, as attributes `width` and `height` of `events`, together
with `contrast`. Other usual names of the columns are read, too (`COLUMN_NAMES`). A group `flight` says where the camera
was, see `Recording.flight`.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.interop.recordings.recording import (
    Recording,
    TimeUnit,
    match_columns,
    one_number,
    recording_of,
    whole_number,
)


def read_hdf5(file: Path, size: tuple[int, int] | None, time_unit: TimeUnit | None) -> Recording:
    """Returns the recording of an HDF5 file.

    Times are microseconds where the file has DSEC's `ms_to_idx`, with which they must agree.

    Raises:
        ConfigError: if it is damaged, or not of this layout.
        MissingPackageError: if h5py is not installed.
    """
    h5py = require_extra("h5py", extra="events")
    require_extra("hdf5plugin", extra="events")  # DSEC's files are compressed with Blosc
    try:
        with h5py.File(file, "r") as opened:
            columns, others = _columns(file, opened)
    except (OSError, RuntimeError, KeyError) as error:
        if "filter" in str(error):
            raise ConfigError(f"'{file}' is compressed with a filter that is not installed: {error}") from None
        raise ConfigError(f"'{file}' is damaged, or no HDF5 file: {error}") from None
    index, offset_us = others.pop("ms_to_idx"), others.pop("t_offset")
    if index is not None:
        _check_index(file, columns["t"], index)
        others["says_unit"] = "us, with DSEC's index of milliseconds"
        time_unit = "us"
    said = others.pop("size")
    return recording_of(str(file), **columns, size=size or said, time_unit=time_unit, offset_us=offset_us, **others)


def _columns(file: Path, opened: Any) -> tuple[dict[str, NDArray], dict[str, Any]]:
    group = opened.get("events")
    names = match_columns(group) if _is_group(group) else None
    if names is None or any(_is_group(group[key]) for key in names.values()):
        raise ConfigError(
            f"'{file}' is not in DSEC's layout, a group 'events' with columns x, y, p and t; "
            f"it holds {_contents(opened)}"
        )
    columns = {key: _read_dataset(group[name]) for key, name in names.items()}

    def found(name: str) -> NDArray | None:
        for place in (opened, group):
            if name in place:
                return _read_dataset(place[name])
        return None

    offset, index, said = found("t_offset"), found("ms_to_idx"), group.attrs
    flight = opened.get("flight")
    return columns, {
        "ms_to_idx": None if index is None or not index.size else index,
        "t_offset": 0 if offset is None else whole_number(str(file), "t_offset", offset),
        "size": (
            (whole_number(str(file), "width", said["width"]), whole_number(str(file), "height", said["height"]))
            if "width" in said and "height" in said
            else None
        ),
        "contrast": one_number(str(file), "contrast", said["contrast"]) if "contrast" in said else None,
        "flight": {key: _read_dataset(flight[key]) for key in flight} if _is_group(flight) else None,
    }


def _read_dataset(place: Any) -> NDArray:
    """Returns what a data set holds; HDF5 has some that hold nothing, without a shape."""
    return np.zeros(0) if getattr(place, "shape", ()) is None else np.asarray(place)


def _is_group(place: Any) -> bool:
    return hasattr(place, "keys")


def _contents(opened: Any) -> str:
    """Returns the names of the first data sets in a file, with their shapes and fields."""
    found: list[str] = []

    def add(name: str, place: Any) -> bool | None:
        if not _is_group(place):
            fields = f" of {', '.join(place.dtype.names)}" if place.dtype.names else ""
            found.append(f"{name} {list(place.shape or ())}{fields}")
        return True if len(found) == 6 else None

    opened.visititems(add)
    return "; ".join(found) or "nothing"


def _check_index(file: Path, t: NDArray, index: NDArray) -> None:
    """Raises unless `ms_to_idx` points at the events that it says.

    Raises:
        ConfigError: names the millisecond.
    """
    if index.ndim != 1 or index.dtype.kind not in "iu":
        raise ConfigError(f"'{file}' is damaged: its ms_to_idx is no column of whole numbers")
    # Where times run back a little, the first event of a millisecond or later is that of the latest time so far.
    wanted = np.searchsorted(np.maximum.accumulate(t), 1000 * np.arange(index.size))
    wrong = np.flatnonzero(index.astype(np.int64) != wanted)
    wrong = wrong[wrong > 0]  # DSEC begins with 0 whatever comes before
    if wrong.size:
        raise ConfigError(
            f"'{file}' is damaged: its ms_to_idx names event {int(index[wrong[0]]):,} for millisecond {wrong[0]:,}, "
            f"which begins with event {int(wanted[wrong[0]]):,}"
        )


def hdf5_bytes(recording: Recording) -> bytes:
    """Returns a recording as an HDF5 file in DSEC's layout.

    Raises:
        MissingPackageError: if h5py is not installed.
    """
    h5py = require_extra("h5py", extra="events")
    events = recording.events
    offset = int(events["t"][0]) if len(events) else 0
    since = events["t"] - offset
    short = not since.size or since[-1] < 2**32
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as opened:
        group = opened.create_group("events")
        columns = {
            "x": events["x"],
            "y": events["y"],
            "p": (events["p"] > 0).astype(np.uint8),
            "t": since.astype(np.uint32 if short else np.int64),
        }
        for key, column in columns.items():
            group.create_dataset(key, data=column, compression="gzip", compression_opts=4, shuffle=True)
        milliseconds = int(since[-1]) // 1000 + 1 if since.size else 0
        index = np.searchsorted(since, 1000 * np.arange(milliseconds)).astype(np.uint64)
        opened.create_dataset("ms_to_idx", data=index)
        opened.create_dataset("t_offset", data=np.int64(offset))
        for key in ("width", "height", "contrast"):
            if getattr(recording, key) is not None:
                group.attrs[key] = getattr(recording, key)
        for key, column in (recording.flight or {}).items():
            opened.create_dataset(f"flight/{key}", data=column)
    return buffer.getvalue()
