"""95 % confidence intervals of what benchmarks compare: of two success rates, and of medians."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from edqn_jax.evaluation.intervals import bootstrap_rates, percentile_interval, rate_interval


def difference_interval(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Returns the interval of the first rate minus the second; [S, M] and [T, M] bool, of the same M missions.

    If one of the rates is 0 or 1, its bootstrap does not vary; the interval is then computed from those of both rates
    (Newcombe, Statistics in Medicine 17, 1998, method 10).

    Raises:
        ValueError: if the numbers of missions differ.
    """
    drawn = bootstrap_rates([first, second])
    if all(0 < np.mean(success) < 1 for success in (first, second)):
        return percentile_interval(drawn[0] - drawn[1])
    (a, b), (low_a, high_a), (low_b, high_b) = (
        map(np.mean, (first, second)),
        rate_interval(first),
        rate_interval(second),
    )
    below, above = np.hypot(a - low_a, high_b - b), np.hypot(high_a - a, b - low_b)
    return float(a - b - below), float(a - b + above)


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """Returns a 95 % confidence interval for the median of the distribution that `values` were drawn from.

    The interval is distribution-free: the median is below the k-th smallest of n values with the probability that
    fewer than k of n tosses of a fair coin are heads. Fewer than six values cannot reach 95 %; the interval is then
    their range.
    """
    ordered, count = sorted(values), len(values)
    left_out = 0
    while sum(math.comb(count, heads) for heads in range(left_out + 2)) <= 0.025 * 2**count:
        left_out += 1
    return ordered[left_out], ordered[-1 - left_out]
