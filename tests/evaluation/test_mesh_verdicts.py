"""Judges of meshes that are not convex and of height fields: trimesh says how far away they are."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh

from edqn_jax.evaluation.judge import MujocoWorld, clearance, load_judge, replay_contact
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.evaluation.verdicts import Agreement, check_verdicts
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.mjcf_parts.files import load_checked_text
from edqn_jax.sim.scene.scene import scene_at
from edqn_jax.sim.task.outcomes import Outcome
from tests.oracles.mesh_distance import signed_distances
from tests.support.meshes import CUBE, hull, mesh_world
from tests.support.policies import CONFIG, always

pytestmark = pytest.mark.whole

RADIUS = 0.36
RING = trimesh.creation.torus(1.2, 0.2, major_sections=24, minor_sections=10)
GATE = np.asarray(RING.vertices)[:, [2, 0, 1]], np.asarray(RING.faces)  # to be flown through along x
MESHES = {"gate": GATE, "block": hull(CUBE * 0.5)}
GEOMS = (
    '<geom name="gate" type="mesh" mesh="gate" pos="8 5 3"/><geom name="block" type="mesh" mesh="block" pos="13 5 3"/>'
    '<geom name="egg" type="ellipsoid" size=".5 1 .4" pos="13 8 3"/>'
)


@pytest.fixture
def world(tmp_path: Path) -> Path:
    return mesh_world(tmp_path, GEOMS, **MESHES)


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
    expected = np.abs(signed_distances(triangles, points)) - RADIUS
    near = [(*clearance(judge, point), there) for point, there in zip(points, expected, strict=True)]
    near = [(distance, there) for distance, name, there in near if name == "gate"]
    assert len(near) > 30
    np.testing.assert_allclose(*np.transpose(near), atol=1e-6)


MOVING = (
    '<body name="a" mocap="true" pos="8 5 3" euler="0 0 40"><geom name="gate" type="mesh" mesh="gate"/>'
    '<body pos="0 0 2.5"><geom name="egg" type="ellipsoid" size=".5 1 .4" euler="20 0 0"/></body></body>'
    '<body name="b" mocap="true" pos="13 5 3"><geom name="block" type="mesh" mesh="block" euler="0 30 10"/></body>'
)
TEXTS = (
    '<custom><text name="motion:a" data="oscillate 0.5 2 0.4 6 0.1"/>'
    '<text name="motion:b" data="bounce 0 -1.5 0.2; circle 0.5 3 0"/></custom></mujoco>'
)


@pytest.fixture
def moving(tmp_path: Path) -> Path:
    """The gate and the block on bodies that move, the gate turned."""
    file = mesh_world(tmp_path, MOVING, **MESHES)
    file.write_text(file.read_text().replace("</mujoco>", TEXTS))
    return file


def test_meshes_that_move_are_judged_where_they_are(moving: Path) -> None:
    judge, scene = load_judge(mujoco.MjSpec.from_string(load_checked_text(moving)), RADIUS), load_scene(moving)
    rng, found = np.random.default_rng(1), []
    cos, sin = np.cos(np.radians(40)), np.sin(np.radians(40))
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    ours = jax.jit(lambda point, time: signed_distance(scene_at(scene, time), point))
    for time in np.linspace(0, 20, 300):
        point = rng.uniform((6, 2, 1.5), (15, 8, 5))
        distance, name = clearance(judge, point, time)
        found.append((float(ours(jnp.asarray(point, jnp.float32), jnp.float32(time))) - RADIUS, distance))
        if name == "gate":
            away = np.array([0.5, 2, 0.4]) * (np.sin(2 * np.pi * (time / 6 + 0.1)) - np.sin(0.2 * np.pi))
            (exact,) = np.abs(signed_distances(GATE[0][GATE[1]] @ turn.T + [8, 5, 3] + away, point[None]))
            assert distance == pytest.approx(exact - RADIUS, abs=1e-6)
    # Within a solid trimesh's distances are not negative.
    grid, exact = np.transpose([each for each in found if each[0] > -RADIUS and each[1] < 0.5 - RADIUS])
    assert len(grid) > 15 and np.all(grid - exact < 0.011) and np.all(exact - grid < 0.1)


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
@pytest.mark.parametrize("moves", [False, True])
def test_flights_at_meshes_of_any_form_are_judged_alike(world: Path, moves: bool) -> None:
    if moves:
        world.write_text(mesh_world(world.parent, MOVING, **MESHES).read_text().replace("</mujoco>", TEXTS))
    course = load_missions(CONFIG, str(world), 60)
    flights = fly_on_all_devices(CONFIG, course.env_params, always((1, 0, 0)), record=True)
    results = check_verdicts(CONFIG, course, flights)
    assert all(result.agrees for result in results), [result for result in results if not result.agrees]
    assert {"gate"} <= {result.touched for result in results if result.judge == "trimesh"}
    assert {result.slack_m for result in results} == {0.1}
