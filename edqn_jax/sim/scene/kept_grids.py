"""Distances of large meshes, kept beside compiled programs from one command to the next."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
from numpy.typing import NDArray

from edqn_jax.devices.cache import private_folder

KEPT_VALUES = 2**18
"""Of a grid that is kept; smaller ones are made in a second or two."""

_MADE_BY = tuple(Path(__file__).with_name(name) for name in ("mesh_field.py", "solid_distance.py"))
_DIGEST = 32  # bytes


def kept_values(made_of: Sequence[bytes], make: Callable[[], NDArray[np.floating]]) -> NDArray[np.float32]:
    """Returns the values of a grid: those that are kept of the same content and code, else made now and kept.

    A damaged file is made anew; where nothing can be kept, nothing is.

    Args:
        made_of: all that the values depend on.
        make: returns them, [X, Y, Z] metres.
    """
    folder = private_folder()
    if folder is None:
        return make().astype(np.float32)
    told_apart = (*made_of, *(source.read_bytes() for source in _MADE_BY), _compiled_by())
    name = hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in told_apart)).hexdigest()[:32]
    file = folder / f"grid-{name}.npy"
    values = _read(file)
    if values is None:
        values = make().astype(np.float32)
        _write(file, values)
    return values


def _compiled_by() -> bytes:
    """Returns what decides the last bits of the values."""
    return f"{jax.__version__} {os.environ.get('XLA_FLAGS', '')}".encode()


def _read(file: Path) -> NDArray[np.float32] | None:
    """Returns the values of a kept file; None if there is none, or it is damaged."""
    try:
        content = file.read_bytes()
    except OSError:
        return None
    if hashlib.sha256(content[_DIGEST:]).digest() != content[:_DIGEST]:
        return None
    return np.load(io.BytesIO(content[_DIGEST:]), allow_pickle=False)


def _write(file: Path, values: NDArray[np.float32]) -> None:
    """Keeps values, if that is possible."""
    packed = io.BytesIO()
    np.save(packed, values)
    content = packed.getvalue()
    # Commands side by side write the same file.
    with contextlib.suppress(OSError), tempfile.TemporaryDirectory(dir=file.parent) as scratch:
        made = Path(scratch) / file.name
        made.write_bytes(hashlib.sha256(content).digest() + content)
        made.replace(file)
