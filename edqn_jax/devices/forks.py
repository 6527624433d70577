"""Whether this process was forked from one in which JAX had already run.

Such a process has JAX's state and none of its threads, so that the first thing it computes waits for ever.
"""

from __future__ import annotations

import os
import sys

from edqn_jax.errors import ConfigError

_without_threads = False


def has_found_devices() -> bool:
    """Returns whether JAX has found its devices in this process, after which their number is fixed."""
    bridge = sys.modules.get("jax._src.xla_bridge")  # JAX has no public name for this
    return bridge is not None and bridge.backends_are_initialized()


def _after_fork() -> None:
    """Notes in a forked process whether JAX had already found its devices in the process before."""
    global _without_threads
    _without_threads = _without_threads or has_found_devices()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def lacks_threads() -> bool:
    """Returns whether this process was forked after JAX had been used."""
    return _without_threads


def check_not_forked() -> None:
    """Checks that JAX can compute in this process.

    Raises:
        ConfigError: if the process was forked after JAX had been used, which cannot be undone.
    """
    if _without_threads:
        raise ConfigError(
            "this process was forked after JAX had been used, and JAX would wait in it for ever; start processes by "
            "'forkserver' or 'spawn', such as vector_kwargs={'context': 'forkserver'} of gymnasium.make_vec or "
            "multiprocessing.get_context('forkserver')"
        )
