"""Which moments of a flight its pictures show."""

from __future__ import annotations

import numpy as np
import pytest

from edqn_jax.report.gallery import _busiest


def test_each_part_of_a_flight_shows_its_busiest_decision():
    events = np.ones(40, int)
    busy = [3, 9, 22, 25, 36]
    events[busy] = [5, 2, 9, 3, 7]
    assert _busiest(events, 5).tolist() == busy


def test_the_rim_of_a_part_is_not_shown_so_that_neighbours_differ():
    events = np.ones(32, int)
    events[[15, 16]] = 9  # the last decision of one half and the first of the other
    events[[5, 20]] = 2
    assert _busiest(events, 2).tolist() == [5, 20]


@pytest.mark.parametrize("decisions", [1, 3, 5])
def test_a_flight_of_fewer_decisions_than_pictures_shows_each_once(decisions):
    assert _busiest(np.zeros(decisions), 5).tolist() == list(range(decisions))
