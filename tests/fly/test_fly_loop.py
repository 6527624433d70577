"""The loop that people copy: it flies as the package's own does, and ends as configured."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import fly_loop
from edqn_jax.fly.faults import Fault
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


@pytest.mark.parametrize(
    ("more", "outcome"),
    [({"camera": Camera(ends_at=52.0)}, Fault.NO_EVENTS), ({"stop": lambda: True}, f"refused: {Fault.STOPPED}")],
    ids=["no events", "stopped"],
)
def test_what_goes_wrong_ends_the_loop_of_one_page(more: dict[str, Any], outcome: str) -> None:
    ended, wire, _ = flown(**more)
    assert ended == outcome
    assert not any(velocity is not None and any(velocity) for now, velocity, _ in wire.sent if now > 52.2)
