"""One run in a folder at a time: a lock that ends with the process that holds it, however that ends."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
from pathlib import Path

from edqn_jax.errors import ConfigError

LOCK = "run.lock"
"""File in a run's folder while the run goes on; it says who writes there."""


class Lock:
    """An exclusive lock on a folder, from `take` until `release` or the end of the process."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / LOCK
        self._held: int | None = None

    def take(self) -> None:
        """Locks the folder.

        Raises:
            ConfigError: if another process holds it, or this one does for another run.
            OSError: if the lock's file cannot be made.
        """
        while self._held is None:
            opened = os.open(self.file, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # Whoever held it before may have removed the file that was opened here.
                if os.path.exists(self.file) and os.path.samestat(os.fstat(opened), os.stat(self.file)):
                    os.truncate(opened, 0)
                    os.write(opened, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
                    self._held = opened
            except BlockingIOError:
                holder = os.read(opened, 200).decode(errors="replace").strip() or "another process"
                raise ConfigError(
                    f"'{self.file.parent}' is in use: {holder} writes a run there; give another folder, or stop it first"
                ) from None
            finally:
                if self._held is None:
                    os.close(opened)

    def release(self) -> None:
        """Unlocks the folder and removes the lock's file; without effect where it is not held."""
        if self._held is None:
            return
        with contextlib.suppress(OSError):
            self.file.unlink(missing_ok=True)
        os.close(self._held)
        self._held = None
