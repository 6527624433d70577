"""Integers from single draws of bits."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.random import integers


@pytest.mark.parametrize("below", [1, 2, 27, 1000])
def test_integers_are_uniform_below_their_bound(below: int) -> None:
    count = 200_000
    drawn = np.asarray(integers(jax.random.key(3), (count,), below))
    assert drawn.dtype == np.int32 and drawn.min() >= 0 and drawn.max() < below
    counts = np.bincount(drawn, minlength=below)
    # Pearson's statistic has mean below - 1 and variance twice that; five deviations.
    statistic = np.sum((counts - count / below) ** 2) / (count / below)
    assert abs(statistic - (below - 1)) <= 5 * np.sqrt(2 * (below - 1))


def test_each_integer_has_its_own_bound() -> None:
    bounds = jnp.asarray([1, 5, 100, 2**31 - 1])
    drawn = np.asarray(integers(jax.random.key(0), (5000, 4), bounds))
    assert (drawn >= 0).all() and (drawn < np.asarray(bounds)).all()
    assert drawn[:, 1].max() == 4 and drawn[:, 2].max() == 99 and drawn[:, 3].max() > 2**30
