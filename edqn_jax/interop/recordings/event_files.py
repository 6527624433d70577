"""Recordings of events in files: which reader and which writer, by the end of a file's name."""

from __future__ import annotations

from pathlib import Path

from edqn_jax.errors import ConfigError
from edqn_jax.files import check_can_write, write_atomically
from edqn_jax.interop.recordings.camera_files import KINDS, read_camera_file
from edqn_jax.interop.recordings.event_hdf5 import hdf5_bytes, read_hdf5
from edqn_jax.interop.recordings.event_npz import npz_bytes, read_npz
from edqn_jax.interop.recordings.event_text import read_text, text_bytes
from edqn_jax.interop.recordings.recording import Recording, TimeUnit

HDF5, TEXT = (".h5", ".hdf5"), (".txt", ".csv")

WRITERS = {".h5": hdf5_bytes, ".hdf5": hdf5_bytes, ".npz": npz_bytes, ".txt": text_bytes}
"""By the end of a file's name."""


def read_events(
    file: str | Path,
    *,
    size: tuple[int, int] | None = None,
    time_unit: TimeUnit | None = None,
    columns: str | None = None,
    stream: int | None = None,
) -> Recording:
    """Returns the recording that a file holds.

    Args:
        file: .h5 or .hdf5, .npz, .txt or .csv, .aedat4, .raw, .dat or .es.
        size: width and height of the image, where the file does not say them.
        time_unit: of the times, where the file does not say it.
        columns: order of a text's columns, such as `x,y,t,p`.
        stream: which stream of events of an .aedat4 that has several.

    Raises:
        ConfigError: if the file is damaged, of another kind, or can be read in several ways.
        MissingPackageError: if the extra `events` is needed and not installed.
    """
    file = Path(file)
    kind = file.suffix.lower()
    if not file.is_file():
        raise ConfigError(f"there is no file '{file}'")
    if columns is not None and kind not in TEXT:
        raise ConfigError(f"--columns is for texts, and '{file}' is none")
    if stream is not None and kind != ".aedat4":
        raise ConfigError(f"--stream is for .aedat4, and '{file}' is none")
    if kind in HDF5:
        return read_hdf5(file, size, time_unit)
    if kind == ".npz":
        return read_npz(file, size, time_unit)
    if kind in TEXT:
        return read_text(file, size, time_unit, columns)
    if kind in KINDS:
        if time_unit not in (None, "us"):
            raise ConfigError(f"'{file}' is {KINDS[kind]}, whose times are in us, not {time_unit}")
        return read_camera_file(file, size, stream)
    ends = ", ".join((*HDF5, ".npz", *TEXT, *KINDS))
    raise ConfigError(f"'{file}' is of no kind that is read, which end in {ends}")


def check_can_write_events(file: Path) -> None:
    """Raises ConfigError if `write_events` cannot write the file.

    Raises:
        ConfigError: says why.
    """
    if file.suffix.lower() not in WRITERS:
        raise ConfigError(f"'{file}' must end in {', '.join(WRITERS)}; other kinds are only read")
    check_can_write(file)


def write_events(file: str | Path, recording: Recording) -> None:
    """Writes a recording atomically.

    Raises:
        ConfigError: if the file cannot be written.
        MissingPackageError: if the extra `events` is needed and not installed.
    """
    file = Path(file)
    check_can_write_events(file)
    write_atomically(file, WRITERS[file.suffix.lower()](recording))
