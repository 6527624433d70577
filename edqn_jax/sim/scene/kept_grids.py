"""Distances of large meshes, kept beside compiled programs from one command to the next."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
from numpy.typing import NDArray

from edqn_jax.devices.cache import private_folder
from edqn_jax.devices.kept_files import kept_array, name_of

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
    told_apart = (*made_of, *(source.read_bytes() for source in _MADE_BY), _compiled_by())
    return kept_array(private_folder(), f"grid-{name_of(*told_apart)}", lambda: make().astype(np.float32))


def _compiled_by() -> bytes:
    """Returns what decides the last bits of the values."""
    return f"{jax.__version__} {os.environ.get('XLA_FLAGS', '')}".encode()
