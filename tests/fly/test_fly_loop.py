"""The loop that people copy: it flies as the package's own does, and ends as configured."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest

import fly_loop
from edqn_jax.fly.faults import Fault, Inputs
from tests.support.virtual_pilot import FENCE, SETTINGS, Camera, Policy, Time, Wire, make


def flown(camera: Camera | None = None, **more: Any) -> tuple[str, Wire, Policy]:
    wire, policy, source, clock = Wire(), Policy(), camera or Camera(), Time()
    flier: Any = policy
    vehicle: Any = wire
    return fly_loop.fly(flier, vehicle, source, clock, SETTINGS, FENCE, **more), wire, policy


def test_the_loop_of_one_page_sends_what_the_packages_sends() -> None:
    outcome, wire, policy = flown()
    pilot, other = make()
    assert outcome == pilot.fly().outcome == "goal" and policy.resets == 1
    assert wire.asked == other.asked == ["offboard", "hold"]
    moving = [each[1:] for each in wire.sent if each[1] is not None and any(each[1])]
    assert set(moving) == {((3.0, 0.0, 0.0), 0.25)} and len(moving) > 100
    gaps = np.diff([now for now, velocity, _ in wire.sent if velocity is not None])
    assert gaps.max() < 0.05


@pytest.mark.parametrize("fault", [Fault.NO_EVENTS, Fault.STOPPED], ids=str)
def test_what_goes_wrong_ends_the_loop_of_one_page(fault: Fault) -> None:
    calls = itertools.count()
    stopped = {"stop": lambda: next(calls) > 100} if fault is Fault.STOPPED else {}  # two seconds from the beginning
    ended, wire, _ = flown(Camera(ends_at=52.0 if fault is Fault.NO_EVENTS else np.inf), **stopped)
    assert ended == fault
    moving = [now for now, velocity, _ in wire.sent if velocity is not None and any(velocity)]
    assert moving and max(moving) < 52.2


def test_an_error_in_flight_asks_for_hold() -> None:
    wire: Any = Wire()
    flier: Any = Policy(ValueError("no such events"))
    with pytest.raises(ValueError, match="no such events"):
        fly_loop.fly(flier, wire, Camera(), Time(), SETTINGS, FENCE)
    assert wire.asked[-1] == "hold"


def test_who_steered_before_the_flight_is_forgotten() -> None:
    class Steered(Wire):
        """Someone chose a mode before."""

        other = True

        def inputs(self) -> Inputs:
            return dataclasses.replace(super().inputs(), other_master=self.other)

        def forget_masters(self) -> None:
            self.other = False

    wire: Any = Steered()
    flier: Any = Policy()
    assert (
        fly_loop.fly(flier, wire, Camera(), Time(), SETTINGS, FENCE) == make(wire=Steered())[0].fly().outcome == "goal"
    )
