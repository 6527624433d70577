"""Recordings as NumPy's `.npz`: arrays t, x, y and p, or one structured array of these fields; never a pickle.

Other usual names are read, too (`COLUMN_NAMES`).
"""

from __future__ import annotations

import io
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.interop.recordings.recording import (
    MICROSECONDS,
    Recording,
    TimeUnit,
    match_columns,
    one_number,
    recording_of,
    whole_number,
)

FLIGHT = "flight_"
"""What the names of the arrays of `Recording.flight` begin with."""


def read_npz(file: Path, size: tuple[int, int] | None, time_unit: TimeUnit | None) -> Recording:
    """Returns the recording of an `.npz`.

    Besides the events it may hold `width`, `height`, `time_unit` (s, ms, us or ns) and `contrast`.

    Raises:
        ConfigError: if it is damaged, or has no such arrays.
    """
    if not zipfile.is_zipfile(file):
        raise ConfigError(f"'{file}' is no .npz file, which is an archive of arrays, or was cut off")
    try:
        # np.load leaves a file open that it cannot read.
        with file.open("rb") as content, np.load(content, allow_pickle=False) as opened:
            held = {key: opened[key] for key in opened.files}
    except ValueError as error:  # NumPy's own words advise to load pickled data, which this never does
        if "allow_pickle" in str(error):
            raise ConfigError(f"'{file}' holds pickled objects, which are never loaded") from None
        raise ConfigError(f"'{file}' is damaged, or no .npz file of plain arrays") from None
    except (OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise ConfigError(f"'{file}' is damaged, or no .npz file: {error}") from None
    name = str(file)
    columns = _columns(file, held)
    if size is None and "width" in held and "height" in held:
        size = whole_number(name, "width", held["width"]), whole_number(name, "height", held["height"])
    known: dict[str, Any] = {
        "contrast": one_number(name, "contrast", held["contrast"]) if "contrast" in held else None,
        "flight": {key.removeprefix(FLIGHT): held[key] for key in held if key.startswith(FLIGHT)} or None,
    }
    if time_unit is None and "time_unit" in held:
        said = _word(held["time_unit"])
        if said not in MICROSECONDS:
            raise ConfigError(f"'{file}' says that its times are in '{said}'; give --time-unit s, ms, us or ns")
        time_unit, known["says_unit"] = said, f"{said}, as the file says"
    return recording_of(name, **columns, size=size, time_unit=time_unit, **known)


def _word(held: NDArray) -> str:
    """Returns the text that is held by itself or as an array of one."""
    word = np.asarray(held).reshape(-1)[0] if np.size(held) == 1 else held
    return word.decode("latin-1") if isinstance(word, bytes) else str(word)


def _columns(file: Path, held: dict[str, NDArray]) -> dict[str, NDArray]:
    """Returns t, x, y and p: the arrays of these names, or the fields of the only array that has them.

    Raises:
        ConfigError: if there are none, or several.
    """
    tables = {key: value for key, value in held.items() if match_columns(_fields(value)) is not None}
    if (names := match_columns(key for key in held if key not in tables)) is not None:
        return {key: held[names[key]] for key in names}
    if len(tables) != 1:
        shapes = ", ".join(f"{key} {list(np.shape(value))}" for key, value in list(held.items())[:6]) or "nothing"
        raise ConfigError(
            f"'{file}' must have arrays t, x, y and p, or one structured array with these fields; it holds {shapes}"
        )
    ((_, table),) = tables.items()
    return {key: table[name] for key, name in (match_columns(_fields(table)) or {}).items()}


def _fields(value: object) -> tuple[str, ...]:
    return getattr(getattr(value, "dtype", None), "names", None) or ()


def npz_bytes(recording: Recording) -> bytes:
    """Returns a recording as an `.npz` file: t int64 microseconds, x and y uint16, p int8 of -1 and 1."""
    held: dict[str, Any] = {key: recording.events[key] for key in "txyp"}
    held["time_unit"] = np.array("us")
    for key in ("width", "height", "contrast"):
        if getattr(recording, key) is not None:
            held[key] = np.array(getattr(recording, key))
    held |= {FLIGHT + key: column for key, column in (recording.flight or {}).items()}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **held)
    return buffer.getvalue()
