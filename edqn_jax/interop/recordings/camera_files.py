"""Recordings in the cameras' own files: which reader, by the end of a file's name; Event Stream is read by faery.

All of them hold microseconds and say which events are ON; Prophesee's do not always say how large the image is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from edqn_jax.errors import ConfigError
from edqn_jax.extras import require_extra
from edqn_jax.interop.recordings.aedat4 import read_aedat4
from edqn_jax.interop.recordings.prophesee_files import read_prophesee
from edqn_jax.interop.recordings.recording import Recording, recording_of

KINDS = {".aedat4": "AEDAT4", ".raw": "EVT", ".dat": "DAT", ".es": "Event Stream"}
"""What is read, by the end of a file's name."""


def read_camera_file(file: Path, size: tuple[int, int] | None, stream: int | None = None) -> Recording:
    """Returns the recording of a camera's own file.

    Args:
        file: to read.
        size: width and height where the file does not say them.
        stream: which of the streams of events in an AEDAT4; None where there is one.

    Raises:
        ConfigError: if it is damaged, of a version that is not read, does not say how large the image is, or holds
            several streams and `stream` is None.
        MissingPackageError: if a package of the extra `events` is needed and not installed.
    """
    kind = KINDS[file.suffix.lower()]
    if kind == "AEDAT4":
        recording = read_aedat4(file, size, stream)
    elif kind == "Event Stream":
        recording = _read_event_stream(file)
    else:
        return read_prophesee(file, size)
    if size not in (None, (recording.width, recording.height)):
        said = f"{recording.width} x {recording.height}"
        raise ConfigError(f"'{file}' says that its image is {said}, not {size[0]} x {size[1]}")
    return recording


def _read_event_stream(file: Path) -> Recording:
    """Returns the recording of a `.es`, whose words hold the time since the event before: it cannot run back.

    Raises:
        ConfigError: if faery cannot read it.
    """
    faery = require_extra("faery", extra="events")
    # A fault in faery's compiled part is a `PanicException`, which is no `Exception`.
    try:
        decoder = faery.events_stream_from_file(file, file_type="es")
        width, height = decoder.dimensions()
        packets = list(decoder)
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise ConfigError(f"'{file}' is damaged, or no Event Stream that is read: {error}") from None
    events: Any = np.concatenate(packets) if packets else np.zeros(0, faery.EVENTS_DTYPE)
    return recording_of(
        str(file),
        t=events["t"].astype(np.int64),
        x=events["x"],
        y=events["y"],
        p=events["on"].astype(np.int8),
        size=(width, height),
        time_unit="us",
        says_unit="us, as Event Stream has it",
    )
