"""Recordings as NumPy's `.npz`: arrays t, x, y and p, or one structured array `events`; never a pickle."""

from __future__ import annotations

import io
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.interop.recording import MICROSECONDS, Recording, TimeUnit, recording_of

FLIGHT = "flight_"
"""What the names of the arrays of `Recording.flight` begin with."""


def read_npz(file: Path, size: tuple[int, int] | None, time_unit: TimeUnit | None) -> Recording:
    """Returns the recording of an `.npz`.

    Besides the events it may hold `width`, `height`, `time_unit` (s, ms, us or ns) and `contrast`.

    Raises:
        ConfigError: if it is damaged, or has no such arrays.
    """
    try:
        # np.load leaves a file open that it cannot read.
        with file.open("rb") as content, np.load(content, allow_pickle=False) as opened:
            held = {key: opened[key] for key in opened.files}
    except ValueError:  # NumPy's own words advise to load pickled data, which this never does
        raise ConfigError(f"'{file}' is damaged, or no .npz file of plain arrays") from None
    except (OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ConfigError(f"'{file}' is damaged, or no .npz file: {error}") from None
    columns = _columns(file, held)
    if size is None and "width" in held and "height" in held:
        size = int(held["width"]), int(held["height"])
    known: dict[str, Any] = {
        "contrast": float(held["contrast"]) if "contrast" in held else None,
        "flight": {key.removeprefix(FLIGHT): held[key] for key in held if key.startswith(FLIGHT)} or None,
    }
    if time_unit is None and "time_unit" in held:
        said = str(held["time_unit"])
        if said not in MICROSECONDS:
            raise ConfigError(f"'{file}' says that its times are in '{said}'; give --time-unit s, ms, us or ns")
        time_unit, known["says_unit"] = said, f"{said}, as the file says"
    return recording_of(str(file), **columns, size=size, time_unit=time_unit, **known)


def _columns(file: Path, held: dict[str, NDArray]) -> dict[str, NDArray]:
    structured = held.get("events")
    place: Any = held if structured is None else structured
    names = held if structured is None else structured.dtype.names or ()
    if not set("txyp") <= set(names):
        raise ConfigError(
            f"'{file}' has neither arrays t, x, y and p nor a structured array 'events' with these fields"
        )
    return {key: place[key] for key in "txyp"}


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
