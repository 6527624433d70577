"""Settings of JAX that the package was tested with, kept within its functions whatever a process has set."""

from __future__ import annotations

import contextlib
import functools
import os
import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax

Given = ParamSpec("Given")
Returned = TypeVar("Returned")


class Setting(NamedTuple):
    """A JAX setting, its value within the package, and the reason."""

    value: Any
    context: Callable[[Any], contextlib.AbstractContextManager[Any]]
    """Sets it for a thread, until the end of a `with` block."""
    other: str
    """Effect of other values."""


TESTED = {
    "jax_enable_x64": Setting(False, jax.enable_x64, "mixes precisions in scans, which JAX refuses"),
    "jax_numpy_dtype_promotion": Setting("standard", jax.numpy_dtype_promotion, "refuses MJX's arithmetic and ours"),
    "jax_numpy_rank_promotion": Setting("allow", jax.numpy_rank_promotion, "refuses MJX's arithmetic"),
    "jax_transfer_guard_host_to_device": Setting(
        "allow", jax.transfer_guard_host_to_device, "refuses numbers and NumPy's arrays as arguments"
    ),
    "jax_transfer_guard_device_to_host": Setting(
        "allow", jax.transfer_guard_device_to_host, "refuses results on the host"
    ),
    "jax_transfer_guard_device_to_device": Setting(
        "allow", jax.transfer_guard_device_to_device, "refuses several devices"
    ),
    "jax_disable_jit": Setting(False, jax.disable_jit, "runs nothing that is compiled ahead of its first call"),
    "jax_debug_nans": Setting(False, jax.debug_nans, "refuses NaN, which marks what there is none of"),
    "jax_debug_infs": Setting(False, jax.debug_infs, "refuses infinity, the distance where a ray meets nothing"),
    "jax_check_tracer_leaks": Setting(False, jax.check_tracer_leaks, "refuses MJX"),
    "jax_debug_key_reuse": Setting(False, jax.debug_key_reuse, "refuses keys that are folded and split"),
    "jax_default_prng_impl": Setting("threefry2x32", jax.default_prng_impl, "draws other worlds and flights"),
    "jax_threefry_partitionable": Setting(True, jax.threefry_partitionable, "draws other worlds and flights"),
    "jax_default_matmul_precision": Setting(None, jax.default_matmul_precision, "rounds otherwise"),
}
"""By the name in `jax.config`, which in capitals is that of the environment variable."""

_UNSET = {
    "jax_transfer_guard_host_to_device",
    "jax_transfer_guard_device_to_host",
    "jax_transfer_guard_device_to_device",
}
"""Settings whose None is their tested value, where the one for all of them is None, too."""


_of_thread = threading.local()


def untested_settings() -> list[str]:
    """Returns the names of the settings that are not as tested."""
    config: Any = jax.config
    guarded = config.jax_transfer_guard not in (None, "allow")
    return [
        name
        for name, setting in TESTED.items()
        if (guarded if (now := getattr(config, name)) is None and name in _UNSET else now != setting.value)
    ]


def set_as_tested() -> list[str]:
    """Sets every setting to what was tested, for the whole process; for commands, before anything is compiled.

    Returns:
        the settings that were others, as NAME=VALUE, in the spelling of environment variables.
    """
    told = []

    def update(name: str, value: Any) -> None:
        told.append(f"{name.upper()}={os.environ.get(name.upper(), getattr(jax.config, name))}")
        jax.config.update(name, value)

    if jax.config.jax_transfer_guard not in (None, "allow"):  # pyright: ignore[reportAttributeAccessIssue]
        update("jax_transfer_guard", "allow")  # which sets those of each direction, too
    for name in untested_settings():
        update(name, TESTED[name].value)
    return told


def keep_tested_settings() -> None:
    """Applies the tested settings to this thread until it ends; for threads of a pool."""
    _of_thread.settings = use_tested_settings()  # kept: one that is collected ends
    _of_thread.settings.__enter__()


@contextlib.contextmanager
def use_tested_settings() -> Iterator[None]:
    """Makes the settings of this thread those that were tested, within the block; does nothing where they are."""
    with contextlib.ExitStack() as stack:
        for name in untested_settings():
            stack.enter_context(TESTED[name].context(TESTED[name].value))
        yield


def as_tested(function: Callable[Given, Returned]) -> Callable[Given, Returned]:
    """Returns the function, run with the settings that were tested; also where it is traced in a user's own program."""

    @functools.wraps(function)
    def with_settings(*args: Given.args, **kwargs: Given.kwargs) -> Returned:
        if not untested_settings():
            return function(*args, **kwargs)
        with use_tested_settings():
            return function(*args, **kwargs)

    return with_settings
