"""Whether a program is one of the package's own, that runs where it is compiled and nowhere else.

What is small is then done in C. A program of a user's may be exported, differentiated or spread over devices by the
compiler, none of which can be done with a call to a function in C.
"""

from __future__ import annotations

import contextlib
import contextvars
import gc
import threading
from collections.abc import Iterator

_IS_OWN = contextvars.ContextVar("programs are the package's own", default=False)

_lock = threading.Lock()
_pauses: list[bool] = []  # of each pause that lasts, whether there was garbage collection before


@contextlib.contextmanager
def own_program() -> Iterator[None]:
    """Has what is traced and lowered within taken for a program of the package's own.

    What `jax.jit` has traced or lowered before is not done again, and stays as it is.
    """
    token = _IS_OWN.set(True)
    try:
        yield
    finally:
        _IS_OWN.reset(token)


@contextlib.contextmanager
def without_collection() -> Iterator[None]:
    """Pauses garbage collection, in all threads, until the last of those that overlap ends; what was off stays off.

    While a large program is traced, Python would walk over all that JAX holds again and again, a fifth of the time.
    """
    with _lock:
        _pauses.append(gc.isenabled() or any(_pauses))
        gc.disable()
    try:
        yield
    finally:
        with _lock:
            was_on = _pauses.pop()
            if was_on and not _pauses:
                gc.enable()


def is_own_program() -> bool:
    """Returns whether what is traced or lowered now is of a program of the package's own."""
    return _IS_OWN.get()
