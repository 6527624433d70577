"""Checkpoints of a whole run, from which it is continued: `checkpoints/step-N` after N training steps.

A checkpoint has this name when it is complete and on the disk, never before. The newest are kept; one that is damaged
is set aside, and the one before it is used.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from edqn_jax.errors import ConfigError, DamagedError
from edqn_jax.files import unwritable
from edqn_jax.runs.checkpoints import arrays, manifest
from edqn_jax.version import package_version

_NAME = re.compile(r"step-(\d{9,})")
_HOST, _CONFIG = "host.json", "config.yaml"
_PIECE = 1 << 20  # bytes


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """What a run is continued from."""

    arrays: dict[str, np.ndarray]
    """Train state and the parameters kept so far, by name; none of them is empty."""
    host: dict[str, Any]
    """The rest, as plain JSON data; `files` has the lengths and digests of the run's growing files."""
    config: str
    """Content of the run's `config.yaml`."""
    facts: dict[str, str]
    """Of the manifest: versions and reward. Its checksums have the digest of the configuration."""
    folder: Path = Path()
    """Where it was read from."""


def save(folder: Path, step: int, checkpoint: Checkpoint, keep: int) -> Path:
    """Writes a checkpoint into `folder`, a run's `checkpoints/`, and deletes all but the `keep` newest.

    Raises:
        ConfigError: if it cannot be written; those that were there are there still.
    """
    folder = folder.absolute()
    place = folder / f"step-{step:09}"
    partial = place.with_name(place.name + ".partial")
    remove_partials(folder)
    shapes = {name: [list(array.shape), str(array.dtype)] for name, array in checkpoint.arrays.items()}
    host = {**checkpoint.host, "arrays": shapes}
    texts = {_HOST: json.dumps(host, allow_nan=False) + "\n", _CONFIG: checkpoint.config}
    # Names of arrays are no names of files; numbers are.
    numbered = {str(number): array for number, array in enumerate(checkpoint.arrays.values())}
    arrays.write(partial, numbered, checkpoint.facts, texts)
    try:
        if place.exists():  # of a run that was begun anew from the step before
            shutil.rmtree(place)
        partial.rename(place)
        manifest.sync(folder)
        for _, older in list(_newest_first(folder))[keep:]:
            shutil.rmtree(older, ignore_errors=True)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise unwritable(place, error.strerror) from None
    return place


def newest(
    folder: Path, usable: Callable[[Checkpoint], None], message: Callable[[str], None], *, set_aside: bool = True
) -> Checkpoint | None:
    """Returns the newest checkpoint that is undamaged and usable; None if there never was one.

    Damaged ones are renamed, so that nothing of them is read again; others are passed over.

    Args:
        folder: a run's `checkpoints/`.
        usable: raises ConfigError if a checkpoint cannot be used because of what it depends on.
        message: told of each that is set aside or passed over.
        set_aside: whether damaged ones are renamed.

    Raises:
        ConfigError: if there are some and none can be used.
    """
    for step, place in list(_newest_first(folder)):
        try:
            checkpoint = _read(place)
            usable(checkpoint)
            return checkpoint
        except DamagedError as error:
            if set_aside:
                _set_aside(place)
            message(f"the checkpoint after training step {step:,} is set aside: {error}")
        except ConfigError as error:
            message(f"the checkpoint after training step {step:,} is passed over: {error}")
    if any(folder.glob("step-*")):
        raise ConfigError(f"no checkpoint in '{folder}' can be used; --resume never begins the run anew")
    return None


def versions() -> dict[str, str]:
    """Returns the versions that a checkpoint belongs to."""
    return {"edqn_jax": package_version(), "jax": jax.__version__}


def grown(files: Mapping[str, Path]) -> dict[str, list[Any]]:
    """Returns length and SHA-256 of each of a run's growing files, written to the disk.

    Raises:
        OSError: if one cannot be read or written to the disk.
    """
    found = {}
    for name, file in files.items():
        if file.is_file():
            manifest.sync(file)
            found[name] = [file.stat().st_size, manifest.digest(file)]
    return found


def check_grown(files: Mapping[str, Path], said: Mapping[str, list[Any]]) -> None:
    """Raises unless each file begins with what it held when a checkpoint was saved.

    Raises:
        ConfigError: names the first file that does not.
    """
    for name, (length, digest) in said.items():
        if name not in files or not files[name].is_file() or _digest_of_first(files[name], length) != digest:
            raise ConfigError(f"'{files.get(name, name)}' does not begin with what it held when it was saved")


def cut_back(files: Mapping[str, Path], said: Mapping[str, list[Any]]) -> None:
    """Cuts each file to what it held when a checkpoint was saved; deletes those that it did not have.

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
            raise unwritable(file, error.strerror) from None


def remove_partials(folder: Path) -> None:
    """Deletes what an interrupted process has left of checkpoints."""
    for leftover in folder.glob("step-*.partial*"):
        shutil.rmtree(leftover, ignore_errors=True)


def _read(place: Path) -> Checkpoint:
    """Returns the checkpoint in a folder.

    Raises:
        ConfigError: if it is damaged or unreadable.
    """
    facts = manifest.check(place)
    try:
        host = json.loads((place / _HOST).read_text(encoding="utf-8"))
        config = (place / _CONFIG).read_text(encoding="utf-8")
        shapes = {str(name): (tuple(shape), str(kind)) for name, (shape, kind) in host.pop("arrays").items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise ConfigError(f"'{place}' is no checkpoint of a run") from None
    held = arrays.read(place)
    named = {}
    for number, (name, shape) in enumerate(shapes.items()):
        array = held.get(str(number)) if isinstance(held, dict) else None
        if not isinstance(array, np.ndarray) or (array.shape, str(array.dtype)) != shape:
            raise ConfigError(f"'{place}' does not hold the array '{name}' that it names")
        named[name] = array
    return Checkpoint(named, host, config, facts, place)


def _newest_first(folder: Path) -> Iterator[tuple[int, Path]]:
    """Yields step and folder of each complete checkpoint."""
    found: Iterable[Path] = folder.iterdir() if folder.is_dir() else ()
    numbered = [(int(match[1]), place) for place in found if (match := _NAME.fullmatch(place.name))]
    yield from sorted(numbered, reverse=True)


def _set_aside(place: Path) -> None:
    """Renames a checkpoint that cannot be used."""
    aside = place.with_name(place.name + ".damaged")
    shutil.rmtree(aside, ignore_errors=True)
    try:
        place.rename(aside)
    except OSError as error:
        raise unwritable(place, error.strerror) from None


def _digest_of_first(file: Path, length: int) -> str | None:
    """Returns the SHA-256 of the first bytes of a file; None if it has fewer."""
    summed, left = hashlib.sha256(), length
    with file.open("rb") as opened:
        while left and (piece := opened.read(min(left, _PIECE))):
            summed.update(piece)
            left -= len(piece)
    return summed.hexdigest() if left == 0 else None
