"""Files that a command leaves behind: checked before anything costs time, written atomically."""

from __future__ import annotations

import contextlib
import os
import tempfile
import threading
from pathlib import Path

from edqn_jax.errors import ConfigError

VIDEO, EVENT_FILES = (".gif", ".mp4"), (".h5", ".hdf5", ".npz", ".txt")
"""Endings of the files of one flight that `edqn record` writes."""

SMALLEST = 200
"""Pixels across and down of the smallest video."""

whole_files = threading.Lock()
"""Lock held during atomic writes."""


def cache_folder() -> Path:
    """Returns the folder of what is kept from one command to the next: `$XDG_CACHE_HOME/edqn_jax`, or in `~/.cache`.

    Raises:
        RuntimeError: if there is no home.
    """
    given = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(given) if os.path.isabs(given) else Path.home() / ".cache") / "edqn_jax"


def write_atomically(file: Path, content: str | bytes) -> None:
    """Writes a file atomically, text as UTF-8: after an interruption the old or the new content is there, never a part.

    Raises:
        ConfigError: if it cannot be written.
    """
    partial = file.with_name(file.name + ".partial")
    with whole_files:
        try:
            partial.write_bytes(content.encode() if isinstance(content, str) else content)
            partial.replace(file)
        except OSError as error:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
            raise write_error(file, error.strerror) from None


def check_can_write(file: Path) -> None:
    """Raises ConfigError if `write_atomically` cannot write the file. Its folder must exist.

    Raises:
        ConfigError: says why the file cannot be written.
    """
    folder = file.absolute().parent
    if not os.path.isdir(folder):
        raise write_error(file, f"there is no folder '{folder}'")
    if os.path.isdir(file):
        raise write_error(file, "it is a folder")
    _check_can_make(file, folder, name=file.name)


def check_can_make(folder: Path) -> None:
    """Raises ConfigError if the folder is not writable, and cannot be created together with missing parents.

    Raises:
        ConfigError: says why it cannot be written.
    """
    there = folder.absolute()
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise write_error(folder, f"'{there}' is not a folder")
    _check_can_make(folder, there)


def write_error(path: Path, reason: str | None) -> ConfigError:
    """Returns the error for a file or folder that cannot be written; `reason` is None where the system gives none."""
    return ConfigError(f"'{path}' cannot be written: {reason or 'unknown reason'}")


def _check_can_make(path: Path, there: Path, name: str = "") -> None:
    # Tries it: permission bits say nothing for root or on some file systems. `name` is lengthened as in
    # `write_atomically`.
    try:
        os.rmdir(tempfile.mkdtemp(prefix=name, dir=there))
    except OSError as error:
        raise write_error(path, f"nothing can be created in '{there}' ({error.strerror or 'unknown reason'})") from None


def check_shown(file: Path, size: tuple[int, int] | None, speed: float | None, fps: float | None) -> None:
    """Checks size, speed and frames a second of a video, or the size of a camera of events.

    Raises:
        ConfigError: if one is out of range, or does not belong to such a file.
    """
    suffix = file.suffix.lower()
    least = SMALLEST if suffix in VIDEO else 1
    if size is not None and min(size) < least:
        raise ConfigError(f"--size must be two whole numbers of at least {least}, not {size[0]} {size[1]}")
    if size is not None and suffix == ".mp4" and (size[0] % 2 or size[1] % 2):
        raise ConfigError(f"--size of an .mp4 must be even, not {size[0]} {size[1]}")
    for name, value, most in (("--speed", speed, 100), ("--fps", fps, 50 if suffix == ".gif" else 120)):
        if value is not None and suffix not in VIDEO:
            raise ConfigError(f"{name} is only for videos, and '{file}' is a file of events")
        if value is not None and not 0.01 <= value <= most:
            raise ConfigError(f"{name} must be from 0.01 to {most}, not {value:g}")
