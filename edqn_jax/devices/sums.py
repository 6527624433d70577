"""A check of XLA's sums on this machine, since some versions compute wrong ones on CPUs (docs/decisions/0028)."""

from __future__ import annotations

import functools
import hashlib
import os
import warnings
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxlib.version import __version__ as JAXLIB

from edqn_jax import xla_flags
from edqn_jax.devices.cache import private_folder
from edqn_jax.errors import ConfigError

ROWS = 32_769
"""Rows of the sum that is checked: the smallest number that jaxlib 0.10.2 gets wrong."""

REMEDY = "set XLA_FLAGS=--xla_cpu_experimental_ynn_fusion_type= or install another version of jax"


def squared_norms(rows: Array) -> Array:
    """Returns the squared norm [N] of each row [N, D], by way of a matrix product with the identity.

    The program of jax-ml/jax#39103, of which some versions of XLA get the last row wrong.
    """
    identity = jnp.eye(rows.shape[1], dtype=rows.dtype)
    return jax.vmap(lambda row: jnp.sum((identity @ row) ** 2))(rows)


def count_wrong_sums(rows: int = ROWS, options: Mapping[str, str | bool] | None = None) -> int:
    """Returns how many of so many sums are wrong on the CPU; takes 45 ms, most of it to compile.

    Args:
        rows: sums; row i is (i, 0, 0).
        options: compiler options beyond the defaults of this process.
    """
    numbers = np.zeros((rows, 3), np.float32)
    numbers[:, 0] = np.arange(rows)
    program = jax.jit(squared_norms, compiler_options=dict(options or {}))
    sums = jax.device_get(program(jax.device_put(numbers, jax.local_devices(backend="cpu")[0])))
    return int(np.count_nonzero(sums != numbers[:, 0] ** 2))


def check_sums(options: Mapping[str, str | bool]) -> None:
    """Checks sums of programs that are compiled with these options; once a machine and version of jaxlib.

    Raises:
        ConfigError: if one is wrong.
    """
    record = _record(options)
    if record is not None and record.is_file():
        return
    if count_wrong_sums(options=options):
        raise ConfigError(f"XLA of jaxlib {JAXLIB} computes wrong sums on this CPU; {REMEDY}")
    if record is not None:
        record.touch()


@functools.cache
def check_default_sums() -> None:
    """Warns if programs that a user compiles in this process get wrong sums; checks once a process at most.

    They can where `XLA_FLAGS` switches the sums of YNNPACK on, or where JAX was used before this package was imported,
    so that XLA had read its flags.
    """
    if jax.default_backend() != "cpu":
        return
    try:
        if not xla_flags.jax_was_imported:
            check_sums({})
        elif count_wrong_sums():
            raise ConfigError(
                f"XLA of jaxlib {JAXLIB} computes wrong sums on this CPU with its own defaults, and JAX "
                f"was used before edqn_jax was imported; import edqn_jax first, or {REMEDY}"
            )
    except ConfigError as error:
        warnings.warn(str(error), RuntimeWarning, stacklevel=3)


def _record(options: Mapping[str, str | bool]) -> Path | None:
    """Returns the file that is there once such sums were right; None where no file can be kept."""
    folder = private_folder()
    if folder is None:
        return None
    told_apart = (JAXLIB, sorted(options.items()), os.environ.get("XLA_FLAGS", ""))
    return folder / f"sums-{hashlib.sha256(repr(told_apart).encode()).hexdigest()[:16]}"
