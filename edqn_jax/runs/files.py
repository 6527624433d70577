"""Files that a command leaves behind: checked before anything costs time, written whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

from edqn_jax.errors import ConfigError


def write_whole(file: Path, content: str | bytes) -> None:
    """Writes a file, text as UTF-8; whoever reads it, even after a kill, finds the old one or the new one, never half.

    Raises:
        ConfigError: if it cannot be written.
    """
    partial = file.with_name(file.name + ".partial")
    try:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
        partial.replace(file)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise unwritable(file, error.strerror) from None


def check_can_write(file: Path) -> None:
    """Nothing if `write_whole` can write the file, in a folder that is there.

    Raises:
        ConfigError: if it cannot.
    """
    folder = file.absolute().parent
    if not os.path.isdir(folder):
        raise unwritable(file, f"there is no folder '{folder}'")
    if os.path.isdir(file):
        raise unwritable(file, "it is a folder")
    _check_can_make(file, folder, name=file.name)


def check_can_make(folder: Path) -> None:
    """Nothing if the folder can be written into, or can be made together with those above it that are missing.

    Raises:
        ConfigError: if it cannot.
    """
    there = folder.absolute()
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise unwritable(folder, f"'{there}' is not a folder")
    _check_can_make(folder, there)


def unwritable(path: Path, reason: str | None) -> ConfigError:
    """The error for a file or folder that cannot be written; `reason` is None where the system gives none."""
    return ConfigError(f"'{path}' cannot be written: {reason or 'unknown reason'}")


def _check_can_make(path: Path, there: Path, name: str = "") -> None:
    # By doing it: permissions do not tell for root, nor on every file system. `name` grows as in `write_whole`.
    try:
        os.rmdir(tempfile.mkdtemp(prefix=name, dir=there))
    except OSError as error:
        raise unwritable(path, f"nothing can be made in '{there}' ({error.strerror or 'unknown reason'})") from None
