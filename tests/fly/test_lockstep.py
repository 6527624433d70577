"""A clock that processes share, and the modes of a vehicle with PX4's manners."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.fly.simulated.lockstep import WORK_S, Keeper, SimulatedClock
from edqn_jax.fly.simulated.manners import (
    ACCEPTED,
    DENIED,
    HOLD,
    LAND,
    OFFBOARD,
    TEMPORARILY_REJECTED,
    UNSUPPORTED,
    Limits,
    Manners,
)

STILL = np.zeros(3)


def test_members_wake_in_the_order_of_their_times_and_never_together() -> None:
    keeper, woken = Keeper(), []

    def live(name: str, every: float, times: int) -> None:
        clock = SimulatedClock(keeper.address, name)
        for k in range(times):
            clock.told = name.encode() * (k + 1)
            clock.sleep_until((k + 1) * every)
            woken.append((name, clock.now(), clock.streamed_us))
        before = clock.now()
        clock.work()
        assert clock.now() == pytest.approx(before + WORK_S)
        clock.close()

    threads = [threading.Thread(target=live, args=each) for each in (("a", 0.3, 3), ("b", 0.2, 5))]
    for thread in threads:
        thread.start()
    keeper.admit({"a", "b"}, lambda: True)
    told: list[dict[str, bytes]] = []
    while True:
        told.append(keeper.collect())
        if not keeper.members():
            break
        keeper.wake_first(7)
    for thread in threads:
        thread.join()
    keeper.close()
    expected = sorted([("a", 0.3 * k) for k in (1, 2, 3)] + [("b", 0.2 * k) for k in range(1, 6)], key=lambda e: e[1])
    assert [time for _, time, _ in woken] == pytest.approx([time for _, time in expected])
    assert {streamed for *_, streamed in woken} == {7}
    assert told[0] == {"a": b"a", "b": b"b"}


def test_a_clock_that_is_not_there_and_a_member_that_does_not_come_are_one_sentence() -> None:
    with pytest.raises(ConfigError, match="no simulated clock"):
        SimulatedClock("127.0.0.1:1", "a")
    keeper = Keeper()
    with pytest.raises(ConfigError, match="vehicle did not start"):
        keeper.admit({"vehicle"}, lambda: False)
    keeper.close()


def test_offboard_is_entered_only_while_setpoints_come_and_left_half_a_second_after_they_stop() -> None:
    manners = Manners(Limits())
    assert manners.take_mode(OFFBOARD, 0.0) == TEMPORARILY_REJECTED and manners.mode == HOLD
    manners.take_setpoint(STILL, 0.0, 1.0)
    assert manners.take_mode(OFFBOARD, 1.0) == TEMPORARILY_REJECTED, "one is no stream"
    ahead = np.array([3.0, 0.0, 0.0])
    for k in range(10):
        manners.take_setpoint(ahead, 0.5, 1.0 + 0.02 * k)
    assert manners.take_mode(OFFBOARD, 1.2) == ACCEPTED
    velocity, yaw = manners.wanted(1.6, 0.0, 5.0)
    assert velocity.tolist() == [3.0, 0.0, 0.0] and yaw == 0.5
    velocity, yaw = manners.wanted(1.18 + 0.51, 0.1, 5.0)
    assert manners.mode == HOLD and velocity.tolist() == [0.0, 0.0, 0.0] and yaw == 0.1
    manners.take_setpoint(ahead, 0.5, 1.7)
    assert manners.wanted(1.7, 0.0, 5.0)[0].tolist() == [0.0, 0.0, 0.0], "offboard is not entered again by itself"


def test_what_is_not_a_number_is_no_setpoint() -> None:
    manners = Manners(Limits())
    for k in range(10):
        manners.take_setpoint(np.array([np.nan, 0.0, 0.0]), 0.0, 0.02 * k)
    assert manners.take_mode(OFFBOARD, 0.2) == TEMPORARILY_REJECTED


def test_speeds_are_limited() -> None:
    limits = Limits()
    np.testing.assert_allclose(limits.limit(np.array([30.0, 40.0, 9.0])), [7.2, 9.6, limits.MPC_Z_VEL_MAX_UP])
    np.testing.assert_allclose(limits.limit(np.array([1.0, 2.0, -9.0])), [1.0, 2.0, -limits.MPC_Z_VEL_MAX_DN])


def test_landing_ends_on_the_ground_disarmed_and_nothing_is_disarmed_in_the_air() -> None:
    manners = Manners(Limits())
    assert manners.take_arming(False) == DENIED and manners.armed
    assert manners.take_mode(LAND, 0.0) == ACCEPTED
    assert manners.wanted(0.0, 0.0, 2.0)[0][2] < 0.0
    assert manners.wanted(1.0, 0.0, 0.0)[0].tolist() == [0.0, 0.0, 0.0]
    assert not manners.armed and not manners.airborne
    assert manners.take_arming(True) == ACCEPTED and manners.armed
    assert manners.take_mode((1, 0), 2.0) == UNSUPPORTED
