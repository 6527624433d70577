"""95 % confidence intervals: of success rates over seeds and missions, and of medians.

The rate of a single seed or a single mission has Wilson's interval. If several seeds fly the same missions, the
interval must hold for other seeds and other missions: a bootstrap draws seeds with replacement and missions with
replacement, the same missions for all seeds, because a difficult mission is difficult for every seed (Owen, "The
pigeonhole bootstrap", Ann. Appl. Stat. 1(2), 2007). Methods are strata: seeds are drawn within a method, missions for
all methods together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import trim_mean

from edqn_jax.evaluation.metrics import wilson_interval

DRAWS = 10_000


def interquartile_mean(values: np.ndarray) -> float:
    """Returns the mean of the middle half of values [N] (Agarwal et al. 2021); of fewer than four, of all of them."""
    return float(trim_mean(np.asarray(values, float), 0.25))


def rate_interval(success: np.ndarray) -> tuple[float, float]:
    """Returns the interval of a success rate; `success` is [S, M] bool, S seeds on the same M missions.

    A rate of 0 or 1 has Wilson's interval of M missions, because its bootstrap does not vary.
    """
    success = np.asarray(success, bool)
    if min(success.shape) == 1:
        return wilson_interval(int(success.sum()), success.size)
    if success.all() or not success.any():
        missions = success.shape[1]
        return wilson_interval(missions * int(success.all()), missions)
    return _percentiles(drawn_rates([success])[0])


def difference_interval(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Returns the interval of the first rate minus the second; [S, M] and [T, M] bool, of the same M missions.

    If one of the rates is 0 or 1, its bootstrap does not vary; the interval is then computed from those of both rates
    (Newcombe, Statistics in Medicine 17, 1998, method 10).

    Raises:
        ValueError: if the numbers of missions differ.
    """
    drawn = drawn_rates([first, second])
    if all(0 < np.mean(success) < 1 for success in (first, second)):
        return _percentiles(drawn[0] - drawn[1])
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


def drawn_rates(strata: list[np.ndarray], draws: int = DRAWS, seed: int = 0) -> np.ndarray:
    """Returns success rates [strata, draws] of bootstrap draws; `strata` are [seeds, missions] bool, of equal missions.

    Raises:
        ValueError: if the numbers of missions differ.
    """
    missions = {np.shape(success)[1] for success in strata}
    if len(missions) != 1:
        raise ValueError(f"strata must have the same missions, not {sorted(missions)} of them")
    (count,) = missions
    random = np.random.default_rng(seed)
    times = random.multinomial(count, np.full(count, 1 / count), size=draws)  # [draws, M]
    rates = []
    for success in strata:
        seeds = len(success)
        chosen = random.multinomial(seeds, np.full(seeds, 1 / seeds), size=draws)  # [draws, S]
        rates.append(np.sum((chosen @ np.asarray(success, float)) * times, axis=1) / (seeds * count))
    return np.array(rates)


def _percentiles(values: np.ndarray) -> tuple[float, float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)
