"""Environment variables of Python, JAX, XLA and matplotlib that would change or end a command."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping

from edqn_jax.errors import ConfigError
from edqn_jax.xla_flags import OURS

LEAST_COLUMNS = 60
"""Characters across that tables need so that no number is cut off."""

_PARSES_FLAGS = "from jaxlib import xla_client; xla_client.CompileOptions()"

_PLATFORMS = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")


def prepare_process() -> None:
    """Sets what packages read when they are imported; first of all in a command."""
    # XLA's errors are for people, its warnings for those who write XLA.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    if "MPLBACKEND" in os.environ:  # such as a notebook's, which this Python may lack; nothing is shown on a screen
        os.environ["MPLBACKEND"] = "agg"
    columns = os.environ.get("COLUMNS")
    if columns is not None and not (columns.isdecimal() and int(columns) >= LEAST_COLUMNS):
        os.environ["COLUMNS"] = str(LEAST_COLUMNS)
    if any("error" in option.split(":")[0] for option in sys.warnoptions):
        warnings.simplefilter("default")  # those of other packages would end the command


def start_jax(*, alone: bool = True) -> None:
    """Imports JAX, with the settings that were tested; says so where the environment has others.

    Args:
        alone: whether no other process of the same run uses this machine's GPUs.

    Raises:
        ConfigError: names the variable that JAX or XLA refuses, or the GPU whose memory others use.
    """
    if "jax" not in sys.modules:
        _check_xla_flags(os.environ)
        if alone:
            from edqn_jax.devices.gpu_memory import check_gpus_are_free

            check_gpus_are_free()
    try:
        import jax
    except ValueError as error:
        name = re.search(r"jax_\w+", str(error), re.IGNORECASE)
        if name is None or name[0].upper() not in os.environ:
            raise
        variable = name[0].upper()
        raise ConfigError(
            f"{variable} is '{os.environ[variable]}', which JAX refuses; give another value or none"
        ) from None

    from edqn_jax.devices.jax_settings import set_as_tested

    if told := set_as_tested():
        names, are = ", ".join(told), "is" if len(told) == 1 else "are"
        print(f"edqn: {names} {are} set, but commands use the settings of JAX that were tested", file=sys.stderr)
    platforms = os.environ.get("JAX_PLATFORMS", "")
    known = ",".join(name.strip().lower() for name in platforms.split(",") if name.strip())
    if known != platforms:
        jax.config.update("jax_platforms", known or None)


@contextlib.contextmanager
def platforms_named() -> Iterator[None]:
    """Within the block, in which JAX first looks for its devices, an error that a variable causes names it.

    Raises:
        ConfigError: if JAX finds no device of the kind that the environment asks for.
    """
    try:
        yield
    except (RuntimeError, AssertionError):
        given = [f"{name} is '{os.environ[name]}'" for name in _PLATFORMS if os.environ.get(name, "").strip()]
        if not given or _has_devices():
            raise
        raise ConfigError(
            f"{' and '.join(given)}, but JAX finds no such devices here; unset it, or set it to cpu"
        ) from None


def check_devices() -> None:
    """Raises if JAX finds no device of the kind that the environment asks for, or one that it cannot use.

    Raises:
        ConfigError: as `platforms_named`, or says what JAX says.
    """
    import jax

    try:
        with platforms_named():
            jax.devices()
    except RuntimeError as error:
        said = re.search(r"Unable to initialize backend '(\w+)': (?:\w+: )?([^(\n]*)", str(error))
        if said is None:
            raise
        raise ConfigError(
            f"JAX cannot use the devices of '{said[1]}': {said[2].strip()}; see what uses them (nvidia-smi), or set "
            "JAX_PLATFORMS=cpu"
        ) from None


def _has_devices() -> bool:
    import jax

    try:
        return bool(jax.devices())
    except (RuntimeError, AssertionError):
        return False


def _check_xla_flags(environ: Mapping[str, str]) -> None:
    """Raises if XLA refuses XLA_FLAGS, for which it would end the process; tried in another one.

    Raises:
        ConfigError: says what XLA says.
    """
    flags = environ.get("XLA_FLAGS", "")
    if not flags.replace(OURS, "").strip():
        return
    tried = subprocess.run(
        [sys.executable, "-c", _PARSES_FLAGS], env=dict(environ), capture_output=True, stdin=subprocess.DEVNULL
    )
    said = re.search(r"^[EF]\d{4} .*?\] (.*)", tried.stderr.decode(errors="replace"), re.MULTILINE)
    if tried.returncode and said is not None:
        raise ConfigError(f"XLA refuses XLA_FLAGS='{flags}': {said[1].strip()}")
