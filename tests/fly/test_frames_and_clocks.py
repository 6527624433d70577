"""Frames of an autopilot, and clocks that are not ours."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edqn_jax.fly import frames
from edqn_jax.fly.clocks import ClockOffset
from edqn_jax.interop.deployment.runner import heading_of


def test_places_and_headings_are_those_of_px4() -> None:
    assert frames.from_ned([1.0, 2.0, -3.0]).tolist() == [2.0, 1.0, 3.0]
    assert frames.to_ned(frames.from_ned([1.0, 2.0, 3.0])).tolist() == [1.0, 2.0, 3.0]
    assert frames.yaw_to_ned(0.0) == pytest.approx(np.pi / 2)  # east
    assert frames.yaw_to_ned(np.pi / 2) == pytest.approx(0.0)  # north
    assert frames.yaw_to_ned(frames.yaw_to_ned(1.2)) == pytest.approx(1.2)


def test_attitudes_are_those_of_px4() -> None:
    swap, flip = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1.0, -1, -1])
    for turn in Rotation.from_quat(np.random.default_rng(0).normal(size=(20, 4))):
        q = turn.as_quat(scalar_first=True)
        ours = frames.quaternion_from_ned(q)
        found = Rotation.from_quat(ours, scalar_first=True).as_matrix()
        np.testing.assert_allclose(found, swap @ turn.as_matrix() @ flip, atol=1e-12)
        np.testing.assert_allclose(frames.quaternion_from_ned(ours), q, atol=1e-12)
        np.testing.assert_allclose(frames.rotate(q, [1.0, 2.0, 3.0]), turn.apply([1.0, 2.0, 3.0]), atol=1e-12)
        roll, pitch, yaw = frames.angles_of(q)
        again = Rotation.from_quat(frames.quaternion_of_angles(roll, pitch, yaw), scalar_first=True)
        np.testing.assert_allclose(again.as_matrix(), turn.as_matrix(), atol=1e-9)
    level = frames.quaternion_of_angles(0.0, 0.0, np.radians(30))  # 30 degrees east of north
    yaw = heading_of(frames.quaternion_from_ned(level).astype(np.float32))
    assert np.degrees(yaw) == pytest.approx(60.0, abs=1e-4)


def test_between_two_attitudes_is_halfway() -> None:
    first, last = (frames.quaternion_of_angles(0.0, 0.0, yaw) for yaw in (0.2, 0.4))
    assert frames.angles_of(frames.between(first, -last, 0.5))[2] == pytest.approx(0.3)


def test_another_clock_is_known_by_its_fastest_answers_and_followed_as_it_drifts() -> None:
    rng, offset = np.random.default_rng(1), ClockOffset()
    for k in range(600):  # a minute; the other clock is 1000 s ahead and 50 ppm fast
        sent = 0.1 * k
        there, back = rng.exponential(0.004, 2)
        offset.add_exchange(sent, 1000.0 + (sent + there) * (1 + 5e-5), sent + there + back)
    true = 60.0 - (1000.0 + 60.0 * (1 + 5e-5))
    assert offset.value == pytest.approx(true, abs=2e-3)
    assert offset.jumps == 0


def test_a_clock_that_jumps_is_followed_after_three_samples_and_one_late_message_is_not_a_jump() -> None:
    offset = ClockOffset()
    for k in range(20):
        offset.add_arrival(0.01 * k, 5.0 + 0.01 * k + 0.002 * (k % 3))
    assert offset.value == pytest.approx(5.0)
    offset.add_arrival(0.2, 9.0)
    assert offset.value == pytest.approx(5.0) and offset.jumps == 0
    for k in range(3):
        offset.add_arrival(100.0 + 0.01 * k, 5.3 + 0.01 * k)
    assert offset.value == pytest.approx(-94.7) and offset.jumps == 1
