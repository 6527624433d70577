"""Recordings in the cameras' own files, read by faery: AEDAT4, Prophesee's EVT2, EVT3 and DAT, Event Stream.

Needs the extra `events`. All of them hold microseconds and say which events are ON; Prophesee's do not always say how
large the image is.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from edqn_jax.errors import ConfigError
from edqn_jax.extras import require
from edqn_jax.interop.recording import Recording, recording_of

KINDS = {".aedat4": "AEDAT4", ".raw": "EVT", ".dat": "DAT", ".es": "Event Stream"}
"""What is read, by the end of a file's name."""

EVT_VERSIONS = {"2": ("evt2", 4), "3": ("evt3", 2)}
"""faery's name and the bytes of a word, by version of EVT."""

DAT_WORD = 8
"""Bytes of an event in a DAT file."""

HEADER_BYTES = 65_536
"""How far the header of a file of Prophesee's may reach."""


def read_camera_file(file: Path, size: tuple[int, int] | None) -> Recording:
    """Returns the recording of a camera's own file.

    Args:
        file: to read.
        size: width and height where the file does not say them.

    Raises:
        ConfigError: if it is damaged, of a version that is not read, or does not say how large the image is.
        MissingPackageError: if faery is not installed.
    """
    faery = require("faery", extra="events")
    kind = KINDS[file.suffix.lower()]
    options: dict[str, Any] = {}
    says = kind
    if kind == "EVT":
        options["version_fallback"], says = _evt_version(file)
    if kind == "DAT":
        _check_whole(file, DAT_WORD, binary_header=2)
    if kind in ("EVT", "DAT"):
        # faery takes the fallback where the header says no size: one that no camera has tells both apart.
        options["dimensions_fallback"] = size or (1, 1)
    width, height, packets = _decoded(faery, file, kind, options)
    if (width, height) == (1, 1):
        raise ConfigError(f"'{file}' does not say how large the image is; give --size W H")
    if size is not None and size != (width, height):
        raise ConfigError(f"'{file}' says that its image is {width} x {height}, not {size[0]} x {size[1]}")
    events: Any = np.concatenate(packets) if packets else np.zeros(0, faery.EVENTS_DTYPE)
    return recording_of(
        str(file),
        t=events["t"].astype(np.int64),
        x=events["x"],
        y=events["y"],
        p=events["on"].astype(np.int8),
        size=(width, height),
        time_unit="us",
        says_unit=f"us, as {says} has it",
    )


def _decoded(faery: Any, file: Path, kind: str, options: dict[str, Any]) -> tuple[int, int, list[np.ndarray]]:
    """Returns width, height and the packets of events.

    Raises:
        ConfigError: if faery cannot read the file.
    """
    # A fault in faery's compiled part is a `PanicException`, which is no `Exception`.
    try:
        stream = faery.events_stream_from_file(file, **options)
        width, height = stream.dimensions()
        if (width, height) == (1, 1):
            return 1, 1, []
        return width, height, list(stream)
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise ConfigError(f"'{file}' is damaged, or no {kind} file: {error}") from None


def _evt_version(file: Path) -> tuple[str, str]:
    """Returns faery's name for the version of a `.raw` file, and our own.

    Raises:
        ConfigError: if it does not say one, is of one that is not read, or ends within a word.
    """
    with file.open("rb") as opened:
        lines = _header_lines(opened.read(HEADER_BYTES))
    header = b"\n".join(lines).decode("latin-1")
    found = re.search(r"^% ?(?:evt (\d)\.(\d)|format EVT(\d)(\d)?)", header, re.MULTILINE)
    if found is None:
        raise ConfigError(
            f"'{file}' has no header of Prophesee's that says its version of EVT: it is damaged, or another kind"
        )
    major, minor = (found[1], found[2]) if found[1] else (found[3], found[4] or "0")
    if major not in EVT_VERSIONS or minor != "0":
        raise ConfigError(f"'{file}' is EVT {major}.{minor}; EVT 2.0 and 3.0 are read")
    name, word = EVT_VERSIONS[major]
    _check_whole(file, word)
    return name, f"EVT{major}"


def _header_lines(beginning: bytes) -> list[bytes]:
    """Returns the lines of a header of Prophesee's: each begins with %, and `% end` is the last."""
    lines = []
    while beginning.startswith(b"%") and b"\n" in beginning:
        line, beginning = beginning.split(b"\n", 1)
        lines.append(line)
        if line.strip() == b"% end":
            break
    return lines


def _check_whole(file: Path, word: int, binary_header: int = 0) -> None:
    """Raises if a file ends within a word.

    Raises:
        ConfigError: says that it was cut off.
    """
    with file.open("rb") as opened:
        header = sum(len(line) + 1 for line in _header_lines(opened.read(HEADER_BYTES))) + binary_header
    if (file.stat().st_size - header) % word:
        raise ConfigError(f"'{file}' is damaged: it ends within an event, as a file does that was cut off")
