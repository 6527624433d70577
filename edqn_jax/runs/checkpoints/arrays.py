"""Folders of arrays on disk: written by Orbax, sealed with checksums, and checked before anything of them is read."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from edqn_jax.errors import ConfigError
from edqn_jax.files import unwritable, write_atomically
from edqn_jax.runs.checkpoints import manifest

COMMITTED = "commit_success.txt"
"""File by which Orbax marks a folder as complete."""

_SPARE = 10_000_000
"""Bytes that stay free on the disk, beside what a folder takes."""


def write(
    folder: Path, tree: Any, facts: Mapping[str, str] | None = None, texts: Mapping[str, str] | None = None
) -> None:
    """Writes arrays into a new folder, synchronously: when it returns, everything is on the disk.

    Only the calling process writes, even if it is one of several. What an error leaves is deleted.

    Args:
        folder: absolute; must not exist, its parent may be missing.
        tree: nested dictionaries of arrays, none of them empty.
        facts: kept in the manifest.
        texts: further files, by name.

    Raises:
        ConfigError: if it cannot be written, or the disk has too little space for it.
    """
    tree = jax.tree.map(np.asarray, tree)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        _check_space(folder.parent, sum(leaf.nbytes for leaf in jax.tree.leaves(tree)))
        with _without_traces():
            _alone()[1].save(folder, args=ocp.args.PyTreeSave(tree))
        for name, text in (texts or {}).items():
            write_atomically(folder / name, text)
        if (written := folder / COMMITTED).is_file():
            written.write_text("complete\n", encoding="utf-8")  # Orbax names the whole path in it
        manifest.seal(folder, dict(facts or {}))
    except ConfigError:
        clear(folder)
        raise
    except (OSError, ValueError, RuntimeError) as error:  # Orbax passes on what TensorStore raises
        clear(folder)
        raise unwritable(folder, getattr(error, "strerror", None) or _short(error)) from None


def clear(folder: Path) -> None:
    """Deletes a folder of arrays, and what Orbax has beside it while it is written."""
    for place in (folder, *folder.parent.glob(f"{folder.name}.orbax-checkpoint-tmp*")):
        shutil.rmtree(place, ignore_errors=True)


def read(folder: Path) -> Any:
    """Returns the arrays of a folder that `write` wrote and `manifest.check` has found undamaged; on the host.

    Raises:
        ConfigError: if they cannot be read.
    """
    try:
        with _without_traces():
            handler, reader = _alone()
            folder = folder.absolute()
            described = handler.metadata(folder).tree  # pyright: ignore[reportArgumentType]
            restored = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), described, is_leaf=_is_leaf)
            _check_sizes(folder, described)
            return reader.restore(folder, args=ocp.args.PyTreeRestore(restore_args=restored))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise ConfigError(f"'{folder}' cannot be read: {_short(error)}") from None


def _alone() -> tuple[ocp.PyTreeCheckpointHandler, ocp.Checkpointer]:
    """Returns a handler and a checkpointer of this process; Orbax would otherwise wait for the others of a cluster."""
    here = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(primary_host=here, active_processes={here})
    # Compressing takes longer than writing what it saves.
    handler = ocp.PyTreeCheckpointHandler(use_compression=False, multiprocessing_options=alone)
    return handler, ocp.Checkpointer(handler, multiprocessing_options=alone)


def _check_space(folder: Path, needed: int) -> None:
    free = shutil.disk_usage(folder).free
    if free < needed + _SPARE:
        raise ConfigError(
            f"'{folder}' has {free / 1e6:,.0f} MB of free space, and {(needed + _SPARE) / 1e6:,.0f} MB are needed"
        )


def _not_of_orbax(record: logging.LogRecord) -> bool:
    return "orbax" not in record.getMessage()


@contextlib.contextmanager
def _without_traces() -> Iterator[None]:
    """Within the block Orbax prints no traces of errors that it raises as well; nor do, after one, its other threads.

    Orbax reads and writes all arrays at a time and closes its loop at the first that fails; each of the others, when
    its thread ends or its task is collected, then prints a trace of its own. So what keeps them quiet stays after an
    error.
    """
    before, logger = sys.unraisablehook, logging.getLogger("absl")
    level = logger.level
    logging.getLogger("asyncio").addFilter(_not_of_orbax)  # the same function is added once

    def hook(said: Any) -> None:
        if not (isinstance(said.exc_value, RuntimeError) and str(said.exc_value) == "Event loop is closed"):
            before(said)

    sys.unraisablehook = hook
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
    sys.unraisablehook = before


def _check_sizes(folder: Path, described: Any) -> None:
    """Raises unless the arrays take no more memory than their files on the disk.

    Raises:
        ValueError: if a header declares more.
    """
    declared = sum(
        int(np.prod(leaf.shape, dtype=object)) * np.dtype(leaf.dtype).itemsize
        for leaf in jax.tree.leaves(described, is_leaf=_is_leaf)
    )
    # Files of versions before compression was off may be smaller; nothing that is worth reading shrinks so far.
    held = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    if declared > 1000 * held:
        raise ValueError(f"its files have {held:,} bytes and declare arrays of {declared:,}")


def _is_leaf(node: Any) -> bool:
    return not isinstance(node, dict | list | tuple)


def _short(error: Exception) -> str:
    """Returns what an error of TensorStore says: of the system's ones, what the system says."""
    system = re.search(r"os_error_code='(\d+)'", str(error))
    if system is not None:
        return os.strerror(int(system[1]))
    return " ".join(str(error).split())[:200] or type(error).__name__
