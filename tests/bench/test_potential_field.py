"""The potential field: its force is a gradient, it flies around obstacles, and it reports when it is stuck."""

# pyright: reportArgumentType=false

from __future__ import annotations

import numpy as np
import pytest

from edqn_jax.sim.scene.distance import shape_distances
from rivals.planners import potential_field
from rivals.planners.planner import Budget
from rivals.planners.solids import solid_table
from tests.support.small_worlds import RADIUS, assert_flyable, box, small_world

CONFIG = potential_field.ApfConfig()


def potential(task, point):
    """Returns the sum of Khatib's two potentials."""
    apart = np.linalg.norm(task.goal - point)
    far = CONFIG.conic_m
    value = CONFIG.attraction * (apart**2 / 2 if apart <= far else far * apart - far**2 / 2)
    for distances in shape_distances(task.scene, np.float32(point)).values():
        for distance in np.asarray(distances, np.float64):
            rho = distance - RADIUS
            if rho < CONFIG.influence_m:
                value += CONFIG.repulsion / 2 * (1 / rho - 1 / CONFIG.influence_m) ** 2
    return value


@pytest.mark.parametrize("point", [(2.0, 3.0, 3.0), (4.1, 5.5, 2.0), (7.5, 7.9, 1.5), (9.0, 6.0, 4.0)])
def test_the_force_is_the_downward_slope_of_khatibs_potentials(point):
    task = small_world(box((5, 5, 0), (6, 7, 5)), box((7, 9, 1), (9, 10, 6)))
    gains = CONFIG.attraction, CONFIG.repulsion, CONFIG.influence_m, CONFIG.conic_m
    force = potential_field.force(solid_table(task.scene), *point, task.goal, RADIUS, *gains)
    h = 1e-2  # the scene's distances are float32
    slope = [
        (potential(task, np.array(point) - h * axis) - potential(task, np.array(point) + h * axis)) / (2 * h)
        for axis in np.eye(3)
    ]
    np.testing.assert_allclose(force, slope, rtol=0.02, atol=0.02)


def test_in_the_open_it_goes_straight():
    task = small_world(goal=(10.0, 7.0, 3.5))
    plan = potential_field.plan(task)
    assert_flyable(task, plan.path)
    assert plan.length_m == pytest.approx(np.linalg.norm(task.goal - task.start), rel=0.01)


def test_it_goes_around_what_it_does_not_face():
    task = small_world(box((5.5, 6.5, 0), (6.5, 8.5, 6)))
    plan = potential_field.plan(task)
    assert_flyable(task, plan.path)
    assert plan.length_m > 8.0


def test_it_is_stuck_before_a_wide_wall_though_there_is_a_way():
    task = small_world(box((6, 1.5, 0), (6.5, 10.5, 6)))
    plan = potential_field.plan(task)
    assert plan.reason.startswith("no path: a local minimum of the potential at (")
    assert plan.steps < 1000


def test_the_budget_ends_it():
    assert (
        potential_field.plan(small_world(), Budget(steps=7)).reason
        == "no path: the goal was not reached within 7 steps"
    )


def test_a_step_into_something_is_no_path():
    task = small_world(box((6, 0, 0), (6.5, 12, 6)))
    plan = potential_field.plan(task, config=potential_field.ApfConfig(repulsion=0.0))
    # Nothing pushes back, so it comes within a step of the wall, which begins 0.361 m before x = 6.
    assert plan.reason == "no path: the force drives the drone into an obstacle at (5.6, 6, 3)"
