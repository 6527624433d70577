"""XLA flags that are set when the package is imported, before JAX is first used. Does not import JAX."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, MutableMapping
from importlib import metadata
from pathlib import Path

YNN_OPTION = "xla_cpu_experimental_ynn_fusion_type"
"""XLA's option for the kinds of operation that run in YNNPACK on CPUs; empty for none (docs/decisions/0028)."""

KNOWN_FROM, KNOWN_BELOW = (0, 10, 1), (0, 13)
"""Versions of jaxlib whose XLA knows the option. XLA ends the process at a flag that it does not know."""

jax_was_imported = "jax" in sys.modules
"""Whether JAX was imported before this package. XLA reads its flags once, when JAX is first used."""


OURS = f"--{YNN_OPTION}="
"""The flag that is added to `XLA_FLAGS`."""


def read_flags(environ: Mapping[str, str] = os.environ) -> str:
    """Returns the flags of `XLA_FLAGS`, which may also name a file that holds them."""
    flags = environ.get("XLA_FLAGS", "").strip()
    if flags and not flags.startswith("--") and os.path.isfile(flags):
        return Path(flags).read_text(encoding="utf-8").strip()
    return flags


def disable_ynn_fusions(environ: MutableMapping[str, str] = os.environ) -> None:
    """Adds the flag to `XLA_FLAGS` that keeps XLA from computing sums in YNNPACK.

    Does nothing where `XLA_FLAGS` already names the option, or the installed jaxlib is not one that knows it.

    Args:
        environ: environment variables.
    """
    flags = read_flags(environ)
    if YNN_OPTION not in flags and _knows_option():
        environ["XLA_FLAGS"] = f"{flags} {OURS}".strip()


def _knows_option() -> bool:
    """Returns whether the installed jaxlib is one of the versions that know the option."""
    try:
        numbers = metadata.version("jaxlib").split(".")
        version = tuple(int(number) for number in numbers[:3])
    except (metadata.PackageNotFoundError, ValueError):
        return False
    return KNOWN_FROM <= version < KNOWN_BELOW
