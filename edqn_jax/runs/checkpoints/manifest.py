"""Checksums of the files in a folder, so that damage is noticed before anything of it is used."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from edqn_jax.errors import ConfigError, DamagedError

MANIFEST = "manifest.json"
"""File with the checksums, which is written last: a folder without it is incomplete."""

_MOST_BYTES = 1_000_000  # of a manifest that is worth reading
_PIECE = 1 << 20  # bytes


def seal(folder: Path, facts: dict[str, str] | None = None) -> None:
    """Writes the manifest of a folder, size and SHA-256 of every file below it, and syncs all of it to the disk.

    Args:
        folder: holds only files that are finished.
        facts: kept in the manifest, for `check` to return.

    Raises:
        OSError: if a file cannot be read, or the manifest not be written.
    """
    files = {name: _described(folder / name) for name in _files(folder)}
    text = _text({"facts": facts or {}, "files": files})
    with (folder / MANIFEST).open("w", encoding="utf-8") as file:
        file.write(text)
    for name in (*files, MANIFEST):
        sync(folder / name)
    for path in (*(path for path in folder.rglob("*") if path.is_dir()), folder):
        sync(path)


def check(folder: Path) -> dict[str, str]:
    """Returns the facts of a folder's manifest if its files are those that were sealed, to the last bit.

    Raises:
        DamagedError: names the folder and the first file that is missing, changed or not of it.
        ConfigError: if a file cannot be read.
    """
    file = folder / MANIFEST
    if not file.is_file():
        raise DamagedError(f"'{folder}' is incomplete: it has no {MANIFEST}, so saving it was interrupted")
    try:
        if file.stat().st_size > _MOST_BYTES:
            raise ValueError
        held = file.read_text(encoding="utf-8")
        said = json.loads(held)
        facts, files = said["facts"], said["files"]
        # Whatever was changed in it, its text is no longer the one that follows from it.
        if held != _text({"facts": dict(facts), "files": dict(files)}):
            raise ValueError
    except (ValueError, KeyError, TypeError, RecursionError):
        raise DamagedError(f"'{file}' is damaged: it is not as it was saved") from None
    try:
        here = set(_files(folder))
        for name in sorted(here | set(files)):
            if name not in here:
                raise DamagedError(f"'{folder}' is damaged: '{name}' is missing")
            if name not in files:
                raise DamagedError(f"'{folder}' is damaged: '{name}' was not saved with it")
            if _described(folder / name) != files[name]:
                raise DamagedError(f"'{folder}' is damaged: '{name}' is not as it was saved")
    except OSError as error:
        raise ConfigError(f"'{folder}' cannot be read: {error.strerror or 'unknown reason'}") from None
    return facts


def digest(file: Path) -> str:
    """Returns the SHA-256 of a file, in hexadecimal digits."""
    summed = hashlib.sha256()
    with file.open("rb") as opened:
        while piece := opened.read(_PIECE):
            summed.update(piece)
    return summed.hexdigest()


def sync(path: Path) -> None:
    """Writes what the system still holds of a file or folder to the disk; of a file alone where folders cannot be."""
    if os.name == "nt" and path.is_dir():
        return
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def _files(folder: Path) -> Iterator[str]:
    """Yields the names, relative to the folder, of all files below it but the manifest.

    Raises:
        ConfigError: if one is a link or a device, which a saved folder has none of.
    """
    for path in sorted(folder.rglob("*")):
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise DamagedError(f"'{folder}' is damaged: '{path.relative_to(folder)}' is neither a file nor a folder")
        if path.is_file() and path != folder / MANIFEST:
            yield path.relative_to(folder).as_posix()


def _described(file: Path) -> dict[str, Any]:
    return {"bytes": file.stat().st_size, "sha256": digest(file)}


def _text(content: dict[str, Any]) -> str:
    """Returns the manifest's text, with the SHA-256 of everything else in it."""
    summed = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return json.dumps({**content, "sha256": summed}, indent=1, sort_keys=True) + "\n"
