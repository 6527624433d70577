"""Recordings as text, one event a line.

What we write begins with `# t_us x y p width=W height=H`. Read are columns that spaces, tabs, commas or semicolons
separate; comments begin with #. A first line with the names of the columns decides their order, and a unit in the name
of the time (`t_us`, `t[s]`) that unit. Without one the order is t x y p, as in the event camera dataset of Zurich
(Mueggler et al. 2017).
"""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from edqn_jax.errors import ConfigError
from edqn_jax.interop.recording import Recording, TimeUnit, recording_of

ORDER = ("t", "x", "y", "p")

_NAMES = {"t": "t", "ts": "t", "time": "t", "timestamp": "t", "x": "x", "y": "y", "p": "p", "polarity": "p", "on": "p"}
_TIME = re.compile(r"(t|ts|time|timestamp)(?:[_\[(](s|ms|us|ns)[\])]?)?")
_SIZED = re.compile(r"([xy])@(\d+)")  # as faery writes it


def read_text(
    file: Path, size: tuple[int, int] | None, time_unit: TimeUnit | None, columns: str | None = None
) -> Recording:
    """Returns the recording of a text.

    Args:
        file: to read.
        size: width and height of the image.
        time_unit: of the times.
        columns: their order, such as `x,y,t,p`; None is what the first line says, or `t,x,y,p`.

    Raises:
        ConfigError: if it is no text of four numbers a line.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ConfigError(f"'{file}' is no text: it holds bytes that are not UTF-8") from None
    lines = text.lstrip("\ufeff").split("\n", 1)
    names, unit, said = _header(lines[0])
    body = (
        text.lstrip("\ufeff") if names is None and not lines[0].startswith("#") else lines[1] if len(lines) > 1 else ""
    )
    order = names or ORDER
    if columns is not None:
        order = tuple(word.strip() for word in columns.split(","))
        if sorted(order) != sorted(ORDER):
            raise ConfigError(f"--columns must be t, x, y and p in some order, not '{columns}'")
    if not body.strip():
        raise ConfigError(f"'{file}' holds no events")
    # Whole numbers stay whole: the float64 of a time in nanoseconds since 1970 does not hold it.
    plain = re.sub(r"[,;\t]", " ", body)
    try:
        kinds = [(name, np.int64) for name in order]
        held = np.loadtxt(io.StringIO(plain), dtype=kinds, ndmin=1)
    except ValueError:
        try:
            held = np.loadtxt(io.StringIO(plain), dtype=[(name, np.float64) for name in order], ndmin=1)
        except ValueError as error:
            where = re.search(r"row (\d+)", str(error))
            line = "" if where is None else f", which row {where[1]} does not"
            raise ConfigError(
                f"'{file}' is damaged: each line must hold {len(order)} numbers, {', '.join(order)}{line}"
            ) from None
    says = None if unit is None or time_unit is not None else f"{unit}, as the first line says"
    events: Any = held
    return recording_of(
        str(file),
        **{key: events[key] for key in ORDER},
        size=size or said,
        time_unit=time_unit or unit,
        says_unit=says,
    )


def _header(line: str) -> tuple[tuple[str, ...] | None, TimeUnit | None, tuple[int, int] | None]:
    """Returns the names of the columns, the unit of the times and the size of the image that a first line says."""
    words = re.split(r"[,;\s]+", line.lstrip("#").strip().lower())
    names: list[str] = []
    unit, size = None, {}
    for word in words:
        if sized := re.fullmatch(r"(width|height)=(\d+)", word):
            size[sized[1]] = int(sized[2])
        elif sized := _SIZED.fullmatch(word):
            names.append(sized[1])
            size["width" if sized[1] == "x" else "height"] = int(sized[2])
        elif timed := _TIME.fullmatch(word):
            names.append("t")
            unit = timed[2]
        elif word in _NAMES:
            names.append(_NAMES[word])
    said = (size["width"], size["height"]) if len(size) == 2 else None
    return (tuple(names) if sorted(names) == sorted(ORDER) else None), unit, said  # type: ignore[return-value]


def text_bytes(recording: Recording) -> bytes:
    """Returns a recording as text: microseconds, column, row, polarity of -1 and 1."""
    events = recording.events
    size = "" if recording.width is None else f" width={recording.width} height={recording.height}"
    rows = np.column_stack([events[key].astype(np.int64) for key in ORDER])
    buffer = io.StringIO()
    buffer.write(f"# t_us x y p{size}\n")
    np.savetxt(buffer, rows, fmt="%d")
    return buffer.getvalue().encode()
