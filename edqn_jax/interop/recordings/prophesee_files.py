"""Recordings in Prophesee's files: EVT 2.0 and 3.0 (`.raw`) and DAT 2 (`.dat`), with their headers of text."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edqn_jax.errors import ConfigError
from edqn_jax.interop.recordings.prophesee_words import DAT, EVT2, EVT3, Words
from edqn_jax.interop.recordings.recording import Recording, recording_of

EVT = {"2": EVT2, "3": EVT3}
"""By version."""

DAT_EVENTS = (0, 12)
"""Types of events in DAT 2 that are brightness changes: Event2D and EventCD, of the same bits."""

HEADER_BYTES = 65_536
"""How far a header may reach."""


class Header(NamedTuple):
    """What stands before the words of a file."""

    text: str
    """All lines."""
    length: int
    """In bytes."""
    size: tuple[int, int] | None
    """Width and height of the image; None where it does not say them."""
    begin_us: int
    """Added to the times of the words, as faery writes it (`t0`)."""


def read_prophesee(file: Path, size: tuple[int, int] | None) -> Recording:
    """Returns the recording of a `.raw` or `.dat`.

    Args:
        file: to read.
        size: width and height where the file does not say them.

    Raises:
        ConfigError: if it is damaged, of a version that is not read, or does not say how large the image is.
    """
    with file.open("rb") as opened:
        beginning = opened.read(HEADER_BYTES)
    header = header_of(beginning)
    if not header.length:
        raise ConfigError(f"'{file}' has no header of Prophesee's, lines that begin with '% ', which say what it holds")
    if file.suffix.lower() == ".dat":
        words, begin, says = _dat(file, header, beginning)
    else:
        words, begin, says = _evt(file, header)
    if (file.stat().st_size - begin) % words.dtype.itemsize:
        raise ConfigError(f"'{file}' is damaged: it ends within an event, as a file does that was cut off")
    if size is None and header.size is None:
        raise ConfigError(f"'{file}' does not say how large the image is; give --size W H")
    if size is not None and header.size not in (None, size):
        width, height = header.size
        raise ConfigError(f"'{file}' says that its image is {width} x {height}, not {size[0]} x {size[1]}")
    t, x, y, p, left_out = words.decode(np.fromfile(file, words.dtype, offset=begin))
    if left_out and not len(t):
        raise ConfigError(f"'{file}' has no word that says the time of its {left_out:,} events")
    return recording_of(
        str(file),
        t=t,
        x=x,
        y=y,
        p=p,
        size=header.size or size,
        time_unit="us",
        says_unit=f"us, as {says} has it",
        offset_us=header.begin_us,
        left_out=left_out,
    )


def header_of(beginning: bytes) -> Header:
    """Returns the header that a file of Prophesee's begins with.

    A line of it begins with `% ` and is text; `% end` is the last, where there is one. So words whose first byte is a %
    are none.
    """
    lines, length = [], 0
    while found := re.compile(rb"% [^\x00-\x08\x0e-\x1f\x7f\n]*\n").match(beginning, length):
        lines.append(found[0].decode("latin-1").strip())
        length = found.end()
        if lines[-1] == "% end":
            break
    text = "\n".join(lines)
    sides = [re.search(rf"\b{side}[= ](\d+)", text, re.IGNORECASE) for side in ("width", "height")]
    if geometry := re.search(r"^% geometry:? ?(\d+)x(\d+)", text, re.MULTILINE):
        size = int(geometry[1]), int(geometry[2])
    else:
        size = (int(sides[0][1]), int(sides[1][1])) if sides[0] and sides[1] else None
    begin = re.search(r"^% t0:? (\d+)$", text, re.MULTILINE | re.IGNORECASE)
    return Header(text, length, size, int(begin[1]) if begin else 0)


def _evt(file: Path, header: Header) -> tuple[Words, int, str]:
    """Returns the words of a `.raw`, where they begin, and the name of their format.

    Raises:
        ConfigError: if the header does not say the version, or another one.
    """
    found = re.search(r"^% ?(?:evt (\d)\.(\d)|format EVT(\d)(?:\.?(\d))?)", header.text, re.MULTILINE | re.IGNORECASE)
    if found is None:
        raise ConfigError(f"the header of '{file}' does not say its version of EVT")
    major, minor = (found[1], found[2]) if found[1] else (found[3], found[4] or "0")
    if major not in EVT or minor != "0":
        raise ConfigError(f"'{file}' is EVT {major}.{minor}; EVT 2.0 and 3.0 are read")
    return EVT[major], header.length, f"EVT{major}"


def _dat(file: Path, header: Header, beginning: bytes) -> tuple[Words, int, str]:
    """Returns the words of a `.dat`, where they begin, and the name of their format.

    Raises:
        ConfigError: if it is of another version, or of events that are no changes of brightness.
    """
    version = re.search(r"^% ?Version (\S+)", header.text, re.MULTILINE | re.IGNORECASE)
    if version is not None and version[1].split(".")[0] != "2":
        raise ConfigError(f"'{file}' is DAT {version[1]}; DAT 2 is read")
    if len(beginning) < header.length + 2:
        raise ConfigError(f"'{file}' is damaged: it ends within its header")
    kind, length = beginning[header.length : header.length + 2]
    if kind not in DAT_EVENTS or length != DAT.dtype.itemsize:
        raise ConfigError(
            f"'{file}' holds events of type {kind} and {length} bytes; types 0 (2D) and 12 (CD) of 8 bytes are read"
        )
    if version is None and kind == 0:
        raise ConfigError(f"'{file}' does not say its version of DAT, and events of type 0 differ between them")
    return DAT, header.length + 2, "DAT"
