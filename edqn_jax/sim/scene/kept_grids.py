"""Distances of large meshes, kept beside compiled programs from one command to the next."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
from numpy.typing import NDArray

from edqn_jax.devices.cache import private_folder
from edqn_jax.devices.kept_files import name_of, read_kept, write_kept

KEPT_VALUES = 2**18
"""Of a grid that is kept; smaller ones are made in a second or two."""

_MADE_BY = tuple(Path(__file__).with_name(name) for name in ("mesh_field.py", "solid_distance.py"))


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
    file = folder / f"grid-{name_of(*told_apart)}.npy"
    content = read_kept(file)
    if content is not None:
        return np.load(io.BytesIO(content), allow_pickle=False)
    values, packed = make().astype(np.float32), io.BytesIO()
    np.save(packed, values)
    write_kept(file, packed.getvalue())
    return values


def _compiled_by() -> bytes:
    """Returns what decides the last bits of the values."""
    return f"{jax.__version__} {os.environ.get('XLA_FLAGS', '')}".encode()
