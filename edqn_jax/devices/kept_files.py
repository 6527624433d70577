"""Files that are kept from one command to the next: whole or not at all, and a damaged one is told apart."""

from __future__ import annotations

import contextlib
import hashlib
import io
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_DIGEST = 32  # bytes


def read_kept(file: Path) -> bytes | None:
    """Returns what `write_kept` wrote; None if there is no such file, or it is damaged."""
    try:
        content = file.read_bytes()
    except OSError:
        return None
    return content[_DIGEST:] if hashlib.sha256(content[_DIGEST:]).digest() == content[:_DIGEST] else None


def write_kept(file: Path, content: bytes) -> None:
    """Keeps the content, if that is possible. Commands side by side may write the same file."""
    with contextlib.suppress(OSError), tempfile.TemporaryDirectory(dir=file.parent) as scratch:
        made = Path(scratch) / file.name
        made.write_bytes(hashlib.sha256(content).digest() + content)
        made.replace(file)


def kept_array(folder: Path | None, name: str, make: Callable[[], NDArray[Any]]) -> NDArray[Any]:
    """Returns an array [...] that is kept in a folder by this name, else the one made now, and keeps it.

    Args:
        folder: None if nothing is kept.
        name: tells apart what the array is made of, as of `name_of`.
        make: returns it.
    """
    content = None if folder is None else read_kept(folder / f"{name}.npy")
    if content is not None:
        return np.load(io.BytesIO(content), allow_pickle=False)
    values, packed = make(), io.BytesIO()
    if folder is not None:
        np.save(packed, values)
        write_kept(folder / f"{name}.npy", packed.getvalue())
    return values


def name_of(*parts: bytes) -> str:
    """Returns 32 letters and digits that tell apart what is made of these parts."""
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()[:32]
