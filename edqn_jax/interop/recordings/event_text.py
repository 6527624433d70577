"""Recordings as text, one event a line.

What we write begins with `# t_us x y p width=W height=H`. Read are columns that spaces, tabs, commas or semicolons
separate; comments begin with # or %. A comment at the beginning, or a first line, with the names of the columns
decides their order, and a unit in the name of the time (`t_us`, `t[s]`) that unit. Without names the order is t x y p,
as in the event camera dataset of Zurich (Mueggler et al. 2017), where no other is possible.
"""

from __future__ import annotations

import dataclasses
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edqn_jax.errors import ConfigError
from edqn_jax.interop.recordings.column_order import ORDER, check_usual_order
from edqn_jax.interop.recordings.recording import COLUMN_NAMES, Recording, TimeUnit, match_columns, recording_of

UNITS: dict[str, TimeUnit] = {
    "s": "s",
    "sec": "s",
    "ms": "ms",
    "us": "us",
    "\u00b5s": "us",
    "\u03bcs": "us",
    "ns": "ns",
}
"""As texts write them."""

_UNIT = "|".join(UNITS)
_TIME = re.compile(rf"(.*[a-z])(?:_|[\[(])({_UNIT})[\])]?")
_SIZED = re.compile(r"([xy])@(\d+)")  # as faery writes it
_SIZE = re.compile(r"(?:geometry|resolution|size)\W*(\d+)\s*[x,;\s]\s*(\d+)")
_WORDS = {"true": "1", "on": "1", "false": "0", "off": "0"}


@dataclasses.dataclass
class _Said:
    """What the lines before the events say."""

    lines: int = 0
    """Number of them."""
    order: tuple[str, ...] | None = None
    unit: TimeUnit | None = None
    size: tuple[int, int] | None = None


def read_text(
    file: Path, size: tuple[int, int] | None, time_unit: TimeUnit | None, columns: str | None = None
) -> Recording:
    """Returns the recording of a text.

    Args:
        file: to read.
        size: width and height of the image.
        time_unit: of the times.
        columns: their order, such as `x,y,t,p`; None is what a line names, or `t,x,y,p`.

    Raises:
        ConfigError: if it is no text of four numbers a line, or its columns can be read in several orders.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ConfigError(f"'{file}' is no text: it holds bytes that are not UTF-8") from None
    given = None if columns is None else tuple(word.strip().lower() for word in columns.split(","))
    if given is not None and sorted(given) != sorted(ORDER):
        raise ConfigError(f"--columns must be t, x, y and p in some order, not '{columns}'")
    lines = text.split("\n")
    said = _beginning(file, lines, given is not None)
    body = lines[said.lines :]
    if not any(_strip_comment(line) for line in body):
        raise ConfigError(f"'{file}' holds no events")
    order = given or said.order or ORDER
    held = _numbers(file, body, order, said.lines)
    known = "as given" if given else "as a line says" if said.order else "as no line names them"
    if given is None and said.order is None:
        check_usual_order(str(file), [held[key] for key in order])
    return recording_of(
        str(file),
        t=held["t"],
        x=held["x"],
        y=held["y"],
        p=held["p"],
        size=size or said.size,
        time_unit=time_unit or said.unit,
        says_unit=None if said.unit is None or time_unit is not None else f"{said.unit}, as a line says",
        columns=f"{' '.join(order)}, {known}",
    )


def _beginning(file: Path, lines: list[str], is_order_given: bool) -> _Said:
    """Returns what comments, a size and a line of names say before the first event.

    Raises:
        ConfigError: if the line of names does not name all columns, and their order is not given.
    """
    said = _Said()
    for line in lines:
        words = [word for word in re.split(r"[,;\s]+", _strip_comment(line)) if word]
        sides = None if said.size else re.fullmatch(r"(\d+)(?:\s*[x,;]\s*|\s+)(\d+)", _strip_comment(line))
        is_event = words and not sides and all(_is_number(word) or word.lower() in _WORDS for word in words)
        if is_event or (words and said.order is not None and said.lines and not sides):
            break
        said.lines += 1
        if sides:
            said.size = int(sides[1]), int(sides[2])
            continue
        _read_header(line, said)
        if words and said.order is None and not is_order_given:
            raise ConfigError(
                f"line {said.lines} of '{file}', '{line.strip()[:60]}', is neither an event nor names t, x, y and p; "
                "give --columns if the lines after it are events"
            )
        if words:
            break
    return said


def _read_header(line: str, said: _Said) -> None:
    """Adds to `said` the names of the columns, the unit of the times and the size of the image that a line says."""
    line = re.sub(rf"\s+([\[(](?:{_UNIT})[\])])", r"\1", line.lower().lstrip("#% !").replace('"', ""))
    names: list[str] = []
    unit, size = None, {}
    for word in re.split(r"[,;\s]+", line.strip()):
        if sized := re.fullmatch(r"(width|height)=(\d+)", word):
            size[sized[1]] = int(sized[2])
        elif sized := _SIZED.fullmatch(word):
            names.append(sized[1])
            size["width" if sized[1] == "x" else "height"] = int(sized[2])
        elif (timed := _TIME.fullmatch(word)) and COLUMN_NAMES.get(timed[1]) == "t":
            names.append("t")
            unit = UNITS[timed[2]]
        elif word in COLUMN_NAMES:
            names.append(word)
    if match_columns(names) is not None:
        said.order, said.unit = tuple(COLUMN_NAMES[word] for word in names), unit
    if len(size) == 2:
        said.size = size["width"], size["height"]
    elif found := _SIZE.search(line):
        said.size = int(found[1]), int(found[2])


def _numbers(file: Path, lines: list[str], order: tuple[str, ...], before: int) -> dict[str, NDArray]:
    """Returns the columns of the lines.

    Raises:
        ConfigError: names the first line that does not hold four numbers.
    """
    plain = re.sub(r"[,;\t\"]", " ", "\n".join(lines))
    if re.search(r"[a-df-z]", plain, re.IGNORECASE):  # not the e of 1e6
        plain = re.sub(r"[a-z]+", lambda word: _WORDS.get(word[0].lower(), word[0]), plain, flags=re.IGNORECASE)
    # Whole numbers stay whole: the float64 of a time in nanoseconds since 1970 does not hold it.
    for kind in (np.int64, np.float64):
        try:
            held: Any = np.loadtxt(
                io.StringIO(plain), dtype=[(name, kind) for name in order], ndmin=1, comments=["#", "%"]
            )
        except (ValueError, OverflowError):
            continue
        return {key: held[key] for key in order}
    for number, line in enumerate(plain.split("\n")):
        words = _strip_comment(line).split()
        if words and (len(words) != len(order) or not all(map(_is_number, words))):
            raise ConfigError(
                f"each line of '{file}' must hold {len(order)} numbers, {', '.join(order)}; "
                f"line {before + number + 1}, '{lines[number].strip()[:60]}', does not"
            )
    raise ConfigError(f"each line of '{file}' must hold {len(order)} numbers, {', '.join(order)}")


def _strip_comment(line: str) -> str:
    """Returns a line without quotes and comment."""
    return re.split("[#%]", line, maxsplit=1)[0].replace('"', "").strip()


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def text_bytes(recording: Recording) -> bytes:
    """Returns a recording as text: microseconds, column, row, polarity of -1 and 1."""
    events = recording.events
    size = "" if recording.width is None else f" width={recording.width} height={recording.height}"
    rows = np.column_stack([events[key].astype(np.int64) for key in ORDER])
    buffer = io.StringIO()
    buffer.write(f"# t_us x y p{size}\n")
    np.savetxt(buffer, rows, fmt="%d")
    return buffer.getvalue().encode()
