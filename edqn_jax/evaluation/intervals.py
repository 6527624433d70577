"""95 % confidence intervals of success rates over seeds and missions.

The rate of a single seed or a single mission has Wilson's interval. If several seeds fly the same missions, the
interval must hold for other seeds and other missions: a bootstrap draws seeds with replacement and missions with
replacement, the same missions for all seeds, because a difficult mission is difficult for every seed (Owen, "The
pigeonhole bootstrap", Ann. Appl. Stat. 1(2), 2007). Methods are strata: seeds are drawn within a method, missions for
all methods together.
"""

from __future__ import annotations

import numpy as np

from edqn_jax.evaluation.metrics import wilson_interval

DRAWS = 10_000


def interquartile_mean(values: np.ndarray) -> float:
    """Returns the mean of the middle half of values [N] (Agarwal et al. 2021); of fewer than four, of all of them."""
    from scipy.stats import trim_mean  # takes most of a second to import

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
    return percentile_interval(bootstrap_rates([success])[0])


def bootstrap_rates(strata: list[np.ndarray], draws: int = DRAWS) -> np.ndarray:
    """Returns success rates [strata, draws] of bootstrap draws; `strata` are [seeds, missions] bool, of equal missions.

    Raises:
        ValueError: if the numbers of missions differ.
    """
    missions = {np.shape(success)[1] for success in strata}
    if len(missions) != 1:
        raise ValueError(f"strata must have the same missions, not {sorted(missions)} of them")
    (count,) = missions
    random = np.random.default_rng(0)
    times = random.multinomial(count, np.full(count, 1 / count), size=draws)  # [draws, M]
    rates = []
    for success in strata:
        seeds = len(success)
        chosen = random.multinomial(seeds, np.full(seeds, 1 / seeds), size=draws)  # [draws, S]
        rates.append(np.sum((chosen @ np.asarray(success, float)) * times, axis=1) / (seeds * count))
    return np.array(rates)


def percentile_interval(values: np.ndarray) -> tuple[float, float]:
    """Returns the interval that holds 95 % of the values [N]."""
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)
