"""Judges of meshes that are not convex and of height fields: trimesh says how far away they are."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from edqn_jax.evaluation.judge import MujocoWorld, clearance, load_judge, replay_contact
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.evaluation.verdicts import Agreement, check_verdicts
from edqn_jax.sim.scene.mjcf_parts.files import load_checked_text
from edqn_jax.sim.task.outcomes import Outcome
from tests.oracles.mesh_distance import signed_distances
from tests.support.meshes import CUBE, hull, mesh_world
from tests.support.policies import CONFIG, always

RADIUS = 0.36
RING = trimesh.creation.torus(1.2, 0.2, major_sections=24, minor_sections=10)
GATE = np.asarray(RING.vertices)[:, [2, 0, 1]], np.asarray(RING.faces)  # to be flown through along x
GEOMS = (
    '<geom name="gate" type="mesh" mesh="gate" pos="8 5 3"/><geom name="block" type="mesh" mesh="block" pos="13 5 3"/>'
    '<geom name="egg" type="ellipsoid" size=".5 1 .4" pos="13 8 3"/>'
)


@pytest.fixture
def world(tmp_path: Path) -> Path:
    return mesh_world(tmp_path, GEOMS, gate=GATE, block=hull(CUBE * 0.5))


@pytest.fixture
def judge(world: Path) -> MujocoWorld:
    return load_judge(mujoco.MjSpec.from_string(load_checked_text(world)), RADIUS)


def test_a_gate_is_flown_through_where_c_mujoco_sees_its_hull(judge: MujocoWorld) -> None:
    through = np.linspace((6.0, 5.0, 3.0), (10.0, 5.0, 3.0), 41)
    assert replay_contact(judge, through) is None
    distance, name = clearance(judge, (8.0, 5.0, 3.0))
    assert name == "gate" and distance == pytest.approx(1.0 - RADIUS, abs=0.02)
    assert judge.judge_of("gate") == "trimesh"
    into = replay_contact(judge, through + [0, 1.2, 0])
    assert into is not None and into.geom == "gate" and into.position[0] == pytest.approx(8 - 0.56, abs=0.01)


def test_convex_meshes_and_ellipsoids_are_c_mujocos(judge: MujocoWorld) -> None:
    assert len(judge.meshes) == 1 and {judge.judge_of(name) for name in ("block", "egg")} == {"C MuJoCo"}
    assert clearance(judge, (12.0, 5.0, 3.0)) == (pytest.approx(0.5 - RADIUS, abs=1e-6), "block")


def test_its_distance_is_that_to_the_nearest_of_all_triangles(judge: MujocoWorld) -> None:
    points = np.random.default_rng(0).uniform((6, 3, 1), (10, 7, 5), (60, 3))
    triangles = GATE[0][GATE[1]] + [8, 5, 3]
    (solid,) = judge.meshes.values()
    np.testing.assert_allclose(
        [solid.distance(point) for point in points], np.abs(signed_distances(triangles, points)), atol=1e-6
    )


def test_the_ground_of_a_height_field_is_judged(tmp_path: Path) -> None:
    text = (
        '<mujoco><asset><hfield name="h" nrow="2" ncol="2" size="5 5 2 1" elevation="0 0 1 1"/></asset><worldbody>'
        '<geom name="slope" type="hfield" hfield="h"/></worldbody></mujoco>'
    )
    judge = load_judge(mujoco.MjSpec.from_string(text), RADIUS)
    distance, name = clearance(judge, (1.0, 0.0, 3.0))
    assert name == "slope" and judge.judge_of(name) == "trimesh"
    assert distance == pytest.approx(2 * 10 / np.hypot(10, 2) - RADIUS, abs=1e-6)


@pytest.mark.parametrize(
    ("stated", "found", "apart_m", "left_m", "depth_m", "agrees"),
    [
        (3.5, None, None, 0.06, 0.0, True),  # beside a mesh
        (3.5, None, None, 0.2, 0.0, False),
        (3.5, 4.5, 0.2, 0.04, 0.3, True),  # somewhat early
        (3.5, 2.5, 0.2, -0.004, 0.2, True),
        (3.5, 2.5, 0.2, -0.05, 0.2, False),  # late
        (None, 3.5, None, None, 0.005, True),  # a graze
        (None, 3.5, None, None, 0.05, False),
    ],
)
def test_where_distances_may_be_too_small_contacts_may_be_early(
    stated: float | None, found: float | None, apart_m: float | None, left_m: float | None, depth_m: float, agrees: bool
) -> None:
    outcome = Outcome.GOAL if stated is None else Outcome.COLLISION
    verdict = Agreement(0, outcome, stated, found, apart_m, "mesh", "trimesh", 0.1, left_m, depth_m)
    assert verdict.agrees is agrees
    exact = Agreement(0, outcome, stated, found, apart_m, "box", left_m=left_m, depth_m=depth_m)
    assert not exact.agrees


@pytest.mark.slow
def test_flights_at_meshes_of_any_form_are_judged_alike(world: Path) -> None:
    course = load_missions(CONFIG, str(world), 60)
    flights = fly_on_all_devices(CONFIG, course.env_params, always((1, 0, 0)), record=True)
    results = check_verdicts(CONFIG, course, flights)
    assert all(result.agrees for result in results), [result for result in results if not result.agrees]
    assert {"gate"} <= {result.touched for result in results if result.judge == "trimesh"}
    assert {result.slack_m for result in results} == {0.1}
