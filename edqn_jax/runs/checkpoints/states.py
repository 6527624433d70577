"""Checkpoints of a whole run, from which it is continued: the file `step-N` in `checkpoints/` after N training steps.

A checkpoint has this name when it is complete and on the disk, never before. The newest are kept; one that is damaged
is set aside, and the one before it is used.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from edqn_jax.errors import ConfigError, DamagedError
from edqn_jax.files import write_error
from edqn_jax.runs.checkpoints import sealed
from edqn_jax.version import package_version

_NAME = re.compile(rf"step-(\d{{9,}}){re.escape(sealed.SUFFIX)}")
_HOST, _CONFIG = "host", "config"
_PIECE = 1 << 20  # bytes


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Arrays and texts that a run is continued from."""

    arrays: dict[str, np.ndarray]
    """Train state and the parameters kept so far, by name; none of them is empty."""
    host: dict[str, Any]
    """The rest, as plain JSON data; `files` has the lengths and digests of the run's growing files."""
    config: str
    """Content of the run's `config.yaml`."""
    facts: dict[str, str]
    """Versions and reward."""
    file: Path = Path()
    """Where it was read from."""


def save_checkpoint(folder: Path, step: int, checkpoint: Checkpoint, keep: int) -> Path:
    """Writes a checkpoint into `folder`, a run's `checkpoints/`, and deletes all but the `keep` newest.

    Raises:
        ConfigError: if it cannot be written; those that were there are there still.
    """
    file = folder / f"step-{step:09}{sealed.SUFFIX}"
    remove_partials(folder)
    host = json.dumps(checkpoint.host, allow_nan=False)
    sealed.write_sealed(file, checkpoint.arrays, {**checkpoint.facts, _HOST: host, _CONFIG: checkpoint.config})
    for _, older in list(_newest_first(folder))[keep:]:
        with contextlib.suppress(OSError):
            older.unlink()
    return file


def newest_checkpoint(
    folder: Path, usable: Callable[[Checkpoint], None], message: Callable[[str], None], *, set_aside: bool = True
) -> Checkpoint | None:
    """Returns the newest checkpoint that is undamaged and usable; None if there never was one.

    Damaged ones are renamed and never read again; unusable ones are skipped.

    Args:
        folder: a run's `checkpoints/`.
        usable: raises ConfigError if a checkpoint cannot be used because of what it depends on.
        message: told of each that is set aside or passed over.
        set_aside: whether damaged ones are renamed.

    Raises:
        ConfigError: if there are some and none can be used.
    """
    for step, file in list(_newest_first(folder)):
        try:
            checkpoint = _read(file)
            usable(checkpoint)
            return checkpoint
        except DamagedError as error:
            if set_aside:
                _set_aside(file)
            message(f"the checkpoint after training step {step:,} is set aside: {error}")
        except ConfigError as error:
            message(f"the checkpoint after training step {step:,} is passed over: {error}")
    if any(place.is_dir() and not place.suffix for place in folder.glob("step-*")):
        raise ConfigError(
            f"the checkpoints in '{folder}' are folders, as older versions saved them; this one reads files alone: "
            "continue the run with the version that saved them, or give --resume never"
        )
    if any(folder.glob("step-*")):
        raise ConfigError(f"no checkpoint in '{folder}' can be used; --resume never begins the run anew")
    return None


def checkpoint_versions() -> dict[str, str]:
    """Returns the versions that a checkpoint belongs to."""
    return {"edqn_jax": package_version(), "jax": jax.__version__}


def log_digests(files: Mapping[str, Path]) -> dict[str, list[Any]]:
    """Syncs a run's append-only files; returns length and SHA-256 of each.

    Raises:
        OSError: if one cannot be read or written to the disk.
    """
    found = {}
    for name, file in files.items():
        if file.is_file():
            sealed.sync_to_disk(file)
            found[name] = [file.stat().st_size, sealed.file_digest(file)]
    return found


def check_log_prefix(files: Mapping[str, Path], said: Mapping[str, list[Any]]) -> None:
    """Raises unless each file begins with its content at the time of a checkpoint.

    Raises:
        ConfigError: names the first file that does not.
    """
    for name, (length, digest) in said.items():
        if name not in files or not files[name].is_file() or _digest_of_first(files[name], length) != digest:
            raise ConfigError(f"'{files.get(name, name)}' does not begin with what it held when it was saved")


def truncate_logs(files: Mapping[str, Path], said: Mapping[str, list[Any]]) -> None:
    """Truncates each file to its length at a checkpoint; deletes files that did not exist then.

    Raises:
        ConfigError: if one cannot be written.
    """
    for name, file in files.items():
        try:
            if name in said:
                with file.open("r+b") as opened:
                    opened.truncate(said[name][0])
            else:
                file.unlink(missing_ok=True)
        except OSError as error:
            raise write_error(file, error.strerror) from None


def remove_partials(folder: Path) -> None:
    """Deletes what an interrupted process has left of checkpoints."""
    for leftover in folder.glob("step-*.partial"):
        with contextlib.suppress(OSError):
            leftover.unlink()


def _read(file: Path) -> Checkpoint:
    """Returns the checkpoint in a file.

    Raises:
        ConfigError: if it is damaged or unreadable.
    """
    arrays, texts = sealed.load_sealed(file)
    try:
        host, config = json.loads(texts.pop(_HOST)), texts.pop(_CONFIG)
    except (ValueError, KeyError, TypeError, RecursionError):
        raise ConfigError(f"'{file}' is no checkpoint of a run") from None
    return Checkpoint(arrays, host, config, texts, file)


def _newest_first(folder: Path) -> Iterator[tuple[int, Path]]:
    """Yields step and file of each complete checkpoint, newest first."""
    found: Iterable[Path] = folder.iterdir() if folder.is_dir() else ()
    numbered = [(int(match[1]), file) for file in found if (match := _NAME.fullmatch(file.name))]
    yield from sorted(numbered, reverse=True)


def _set_aside(file: Path) -> None:
    """Renames a checkpoint that cannot be used."""
    try:
        file.replace(file.with_name(file.name + ".damaged"))
    except OSError as error:
        raise write_error(file, error.strerror) from None


def _digest_of_first(file: Path, length: int) -> str | None:
    """Returns the SHA-256 of the first bytes of a file; None if it has fewer."""
    summed, left = hashlib.sha256(), length
    with file.open("rb") as opened:
        while left and (piece := opened.read(min(left, _PIECE))):
            summed.update(piece)
            left -= len(piece)
    return summed.hexdigest() if left == 0 else None
