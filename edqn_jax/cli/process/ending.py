"""The end of a process whose command is done."""

from __future__ import annotations

import atexit
import contextlib
import os
import sys
from typing import NoReturn

from edqn_jax.user_code import IMPORTED


def end_process(code: int) -> NoReturn:
    """Ends this process with an exit code as soon as its output is written.

    Functions registered with `atexit` are called, but for JAX's, which takes its programs apart, and no thread is
    waited for, such as one that compiles what nobody will run: on a busy machine both take up to half a minute. Of a
    cluster's processes, which take leave of one another, each ends in the usual way, and so does one that imported a
    user's code, whose threads may still write.
    """
    jax = sys.modules.get("jax")
    if jax is not None:
        if jax.distributed.is_initialized() or IMPORTED:
            sys.exit(code)
        with contextlib.suppress(ImportError, AttributeError):  # of another JAX, all are called
            from jax._src import api

            atexit.unregister(api.clean_up)
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):
            stream.flush()
    os._exit(code)
