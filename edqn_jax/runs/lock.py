"""One run in a folder at a time: a lock that ends with the process that holds it, however that ends."""

from __future__ import annotations

import contextlib
import os
import socket
from pathlib import Path

import filelock

from edqn_jax.errors import ConfigError

LOCK = "run.lock"
"""File in a run's folder while the run goes on; it says who writes there."""


class Lock(contextlib.AbstractContextManager["Lock"]):
    """An exclusive lock on a folder, until the end of the `with` block, of the object or of the process."""

    def __init__(self, folder: Path) -> None:
        """Locks the folder.

        Raises:
            ConfigError: if a run that goes on holds it.
            OSError: if the lock's file cannot be made.
        """
        self._held: int | None = None  # descriptor of the file
        self.file = folder / LOCK
        while self._held is None:  # whoever held it before may just have removed the file
            self._held = _lock_file(self.file)

    def __exit__(self, *_: object) -> None:
        if self._held is not None:
            with contextlib.suppress(PermissionError):  # Windows deletes no open file; what stays locks nobody out
                self.file.unlink(missing_ok=True)
            self._unlock()

    def __del__(self) -> None:
        if self._held is not None:
            self._unlock()

    def _unlock(self) -> None:
        held, self._held = self._held, None
        assert held is not None
        os.close(held)


def _lock_file(file: Path) -> int | None:
    """Returns the descriptor of the locked file; None if it is no longer the one in the folder.

    Raises:
        ConfigError: if it is locked already.
    """
    opened, kept = os.open(file, os.O_RDWR | os.O_CREAT, 0o644), False
    try:
        if not filelock.lock_descriptor(opened, blocking=False):
            holder = _holder(opened)
            raise ConfigError(
                f"'{file.parent}' is in use: {holder} writes a run there; give another folder, or stop it first"
            )
        kept = file.exists() and os.path.samestat(os.fstat(opened), file.stat())
        if not kept:
            return None
        os.truncate(opened, 0)
        os.write(opened, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        return opened
    finally:
        if not kept:
            os.close(opened)


def _holder(opened: int) -> str:
    """Returns what the holder of a lock has written into its file."""
    with contextlib.suppress(PermissionError):  # on Windows nobody else reads a locked file
        if said := os.read(opened, 200).decode(errors="replace").strip():
            return said
    return "another process"
