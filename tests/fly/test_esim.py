"""The simulated camera's ESIM: its law by hand; beside evlib's in tests/interop."""

from __future__ import annotations

import numpy as np

from edqn_jax.fly.simulated.esim import Esim


def test_an_event_tells_each_contrast_that_the_log_brightness_changes_and_the_rest_is_kept() -> None:
    camera = Esim(0.2)
    levels = [0.0, 0.5, 0.61, 0.0, 0.0]
    seen = [camera.events(0.1 * np.exp([[0.0, level, 0.0]])) for level in levels]
    assert [signs.tolist() for *_, signs in seen] == [[], [1, 1], [1], [-1] * 3, []]
    assert all((columns == 1).all() and (rows == 0).all() for columns, rows, _ in seen)
