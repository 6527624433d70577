"""Intervals of success rates: against cases that can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from edqn_jax.evaluation.intervals import bootstrap_rates, rate_interval
from edqn_jax.evaluation.metrics import wilson_interval
from measurement.intervals import difference_interval


def test_a_single_rate_has_wilsons_interval() -> None:
    one_seed, one_mission = np.array([[True, True, False, True]]), np.array([[True], [False], [True]])
    assert rate_interval(one_seed) == wilson_interval(3, 4)
    assert rate_interval(one_mission) == wilson_interval(2, 3)


def test_where_all_fly_the_missions_alone_say_how_sure_that_is() -> None:
    assert rate_interval(np.ones((5, 40), bool)) == wilson_interval(40, 40)
    assert rate_interval(np.zeros((5, 40), bool)) == wilson_interval(0, 40)


def test_seeds_that_agree_leave_the_missions_chance_and_missions_that_agree_the_seeds() -> None:
    # 30 of 100 missions, the same for every seed: a binomial of 100, whose standard deviation is 0.0458.
    missions = np.tile(np.arange(100) < 30, (8, 1))
    # 6 of 20 seeds, each the same in every mission: a binomial of 20, 0.1025.
    seeds = np.tile((np.arange(20) < 6)[:, None], (1, 50))
    for success, deviation in ((missions, 0.0458), (seeds, 0.1025)):
        drawn = bootstrap_rates([success])[0]
        assert drawn.mean() == pytest.approx(0.3, abs=0.005)
        assert drawn.std() == pytest.approx(deviation, rel=0.05)
    low, high = rate_interval(missions)
    assert (low, high) == pytest.approx((0.3 - 1.96 * 0.0458, 0.3 + 1.96 * 0.0458), abs=0.012)


def test_a_draw_of_seeds_keeps_each_seeds_missions_together() -> None:
    # Half of the seeds fly all, half none: whatever the missions, a draw is a whole number of fifths.
    success = np.tile((np.arange(5) < 2)[:, None], (1, 7))
    np.testing.assert_allclose(np.unique(bootstrap_rates([success])[0]), np.arange(6) / 5, atol=1e-12)


def test_missions_are_drawn_for_both_methods_alike_and_seeds_for_each() -> None:
    hard = np.tile(np.arange(60) % 3 > 0, (4, 1))
    # What is hard is hard for both: no draw of missions tells them apart.
    assert difference_interval(hard, hard[:2]) == pytest.approx((0.0, 0.0), abs=1e-12)
    # One that flies a mission in six beyond that: the difference is a binomial of the missions alone.
    better = hard | (np.arange(60) % 6 == 0)
    low, high = difference_interval(better, hard)
    half = 1.96 * np.sqrt(1 / 6 * 5 / 6 / 60)
    assert (low, high) == pytest.approx((1 / 6 - half, 1 / 6 + half), abs=0.03)


def test_where_one_flies_all_or_nothing_the_difference_is_newcombes() -> None:
    # Ten of ten less none of ten, his method 10: from 0.6075 to 1; here ten missions of three seeds.
    low, high = difference_interval(np.ones((3, 10), bool), np.zeros((2, 10), bool))
    assert (low, high) == pytest.approx((0.6075, 1.0), abs=2e-4)
    low, high = difference_interval(np.zeros((3, 10), bool), np.zeros((2, 10), bool))
    assert low < 0.0 < high  # that neither flies does not prove them alike


def test_an_interval_over_seeds_and_missions_covers_the_true_rate() -> None:
    draw = np.random.default_rng(1)

    def covers() -> bool:
        # How good a seed is, and how hard a mission, add up: the true rate over all of both is a half.
        skill, ease = draw.normal(0, 0.5, (8, 1)), draw.normal(0, 1.0, (1, 40))
        drawn = bootstrap_rates([skill + ease + draw.normal(0, 1.0, (8, 40)) > 0], draws=400)[0]
        low, high = np.percentile(drawn, [2.5, 97.5])
        return low <= 0.5 <= high

    # Eight seeds are few, so a bootstrap is a little too sure; three standard errors of 200 trials are 5 %.
    assert np.mean([covers() for _ in range(200)]) >= 0.88


def test_methods_that_flew_other_missions_cannot_be_compared() -> None:
    with pytest.raises(ValueError, match=r"same missions, not \[3, 4\]"):
        difference_interval(np.ones((2, 3), bool), np.ones((2, 4), bool))
