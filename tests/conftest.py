"""Two simulated CPU devices for every test, and strictness for those that ask for it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import jax
import pytest

from edqn_jax.parallel.devices import use_cpu_devices

use_cpu_devices(2)


@pytest.fixture
def strict_jax() -> Iterator[None]:
    """No silent rank promotion, no key used twice, no leaked tracer; for our own functions, MJX breaks it."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(jax.numpy_rank_promotion("raise"))
        stack.enter_context(jax.debug_key_reuse(True))
        stack.enter_context(jax.checking_leaks())
        yield
