"""Whether a program is one of the package's own, that runs where it is compiled and nowhere else.

What is small is then done in C. A program of a user's may be exported, differentiated or spread over devices by the
compiler, none of which can be done with a call to a function in C.
"""

from __future__ import annotations

import contextlib
import contextvars
from collections.abc import Iterator

_IS_OWN = contextvars.ContextVar("programs are the package's own", default=False)


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


def is_own_program() -> bool:
    """Returns whether what is traced or lowered now is of a program of the package's own."""
    return _IS_OWN.get()
