"""Meshes of an MJCF file: loaded, flown against, seen, drawn, written, judged."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from edqn_jax.config import SHAPES, CameraConfig
from edqn_jax.evaluation.judge import load_judge, replay_contact
from edqn_jax.report.page.worlds import world_data
from edqn_jax.report.worlds.solids import solids_of
from edqn_jax.sim.camera import camera
from edqn_jax.sim.scene import mjcf
from edqn_jax.sim.scene.distance import path_contact, shape_distances
from edqn_jax.sim.scene.mjcf import SceneError
from edqn_jax.sim.scene.mjcf_parts import geoms
from edqn_jax.sim.scene.scene import Scene, scene_shapes, stack_scenes, take_scene, with_equal_capacities
from tests.oracles import mujoco_distance
from tests.support.meshes import CUBE, ball, hull, mesh_world

RADIUS = 0.36
CONFIG = CameraConfig(width=32, height=24)
TABLE = '<geom name="table" type="mesh" mesh="board" pos="8 5 2.5" euler="0 0 30" rgba=".2 .3 .8 1"/>'
EGG = '<geom name="egg" type="mesh" mesh="egg" pos="9 4 4" euler="0 20 40"/>'
OTHER = '<geom name="again" type="mesh" mesh="board" pos="14 5 2" euler="60 0 0"/>'
BOARD = hull(CUBE * [1, 0.6, 0.1] + [0.3, 0, 0])


def egg() -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = ball()
    return vertices * [0.7, 1.4, 0.5], faces


@pytest.fixture
def world(tmp_path: Path) -> Path:
    return mesh_world(tmp_path, TABLE + EGG + OTHER, board=BOARD, egg=egg())


def boxes_only(folder: Path) -> Scene:
    file = folder / "plain.xml"
    file.write_text(mesh_world(folder, '<geom type="box" size="1 1 1" pos="5 5 1"/>').read_text())
    return mjcf.load_scene(file)


def depth_by_mujoco(file: Path, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Metres along the middle ray of each pixel of CONFIG ahead along x, and the geom's number there."""
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    half = np.tan(np.radians(CONFIG.horizontal_fov_deg) / 2)
    found, geoms = np.empty((24, 32)), np.empty((24, 32), int)
    for row, column in np.ndindex(24, 32):
        way = np.array([1, half * (1 - 2 * (column + 0.5) / 32), 0.75 * half * (1 - 2 * (row + 0.5) / 24)])
        geom = np.zeros(1, np.int32)
        there = mujoco.mj_ray(model, data, position, way / np.linalg.norm(way), None, 1, -1, geom)
        found[row, column], geoms[row, column] = np.inf if there < 0 else there, geom[0]
    return found, geoms


def test_its_distance_is_mujocos_where_a_drone_may_touch_it_and_less_elsewhere(world: Path) -> None:
    loaded = mjcf.load_world(world)
    assert loaded.names["fields"] == ("table", "egg", "again") and len(loaded.scene.others["fields"].grids) == 2
    points = np.random.default_rng(0).uniform((6, 2, 0.5), (16, 8, 6), (3000, 3)).astype(np.float32)
    ours = np.asarray(jax.jit(jax.vmap(lambda p: shape_distances(loaded.scene, p)["fields"]))(points))
    for i, name in enumerate(loaded.names["fields"]):
        theirs = mujoco_distance.distances(world, points)[name]
        near = (theirs > 0.01) & (theirs < 0.5)
        assert near.sum() > 30 and np.all(np.abs(ours[near, i] - theirs[near]) < 0.05)
        assert np.all(ours[theirs > 0.01, i] - theirs[theirs > 0.01] < 0.01)
        assert np.all(ours[theirs > 1, i] > 0.4 * theirs[theirs > 1]) and np.all(ours[theirs < -0.1, i] < 0)


def test_a_flight_into_a_mesh_table_collides_where_the_judge_says(world: Path) -> None:
    path = np.linspace((5.0, 4.5, 2.3), (10.0, 5.3, 2.6), 50)
    touch, fraction = jax.jit(path_contact)(mjcf.load_scene(world), jnp.asarray(path, jnp.float32), RADIUS)
    contact = replay_contact(load_judge(world, RADIUS), path)
    assert contact is not None and contact.geom == "table" and np.asarray(touch).sum() == 1
    step, first = np.linalg.norm(path[1] - path[0]), int(np.argmax(touch))
    assert abs(first + float(fraction[first]) - contact.segment - contact.fraction) * step < 0.05


@pytest.mark.parametrize("mount", ["level", "body"])
def test_the_camera_sees_meshes_as_mujoco_does(world: Path, mount: Any) -> None:
    scene, config = mjcf.load_scene(world), dataclasses.replace(CONFIG, mount=mount)
    position = np.array([5.8, 4.8, 3.4])
    depth = np.asarray(jax.jit(partial(camera.render_depth, config, scene))(jnp.asarray(position), jnp.eye(3)))
    theirs, seen = depth_by_mujoco(world, position)
    agree = np.isclose(depth, theirs, rtol=0.05)
    is_mesh = seen > 0
    assert is_mesh.sum() > 60 and agree.mean() >= 0.98 and agree[is_mesh].mean() > 0.97


def test_a_picture_shows_a_mesh_where_the_depth_does_shaded_by_its_side(world: Path, tmp_path: Path) -> None:
    scene, position = mjcf.load_scene(world), np.array([5.8, 4.8, 3.4])
    luma = np.asarray(jax.jit(partial(camera.render_luma, CONFIG, scene))(jnp.asarray(position), jnp.eye(3)))
    _, seen = depth_by_mujoco(world, position)
    # A box instead of the table is the same picture.
    box = TABLE.replace('type="mesh" mesh="board"', 'type="box" size="1 .6 .1"')
    box = box.replace('pos="8 5 2.5"', f'pos="{8 + 0.3 * np.cos(np.pi / 6)} {5 + 0.3 * np.sin(np.pi / 6)} 2.5"')
    plain = mesh_world(tmp_path, box + EGG + OTHER, board=BOARD, egg=egg())
    same = jax.jit(partial(camera.render_luma, CONFIG, mjcf.load_scene(plain)))(jnp.asarray(position), jnp.eye(3))
    apart = np.abs(luma - np.asarray(same))
    table = seen == 1
    assert table.sum() > 30 and np.median(apart[table]) < 0.01 and (apart > 0.05).mean() < 0.03


def test_the_normal_where_a_ray_meets_a_mesh_is_that_of_its_side(world: Path) -> None:
    fields = mjcf.load_scene(world).others["fields"]
    origin, way = jnp.array([8.3, 5.1, 5.5]), jnp.array([0.0, 0.0, -1.0])
    met = SHAPES.get("fields").meet(fields, origin, tuple(way[:, None, None, None]))
    assert bool(met.hit[0, 0, 0]) and abs(float(met.depth[0, 0, 0]) - 2.9) < 0.01
    np.testing.assert_allclose([float(part[0, 0, 0]) for part in met.normal], [0, 0, 1], atol=0.02)


def test_what_is_written_is_the_same_solid(world: Path) -> None:
    scene = mjcf.load_scene(world)
    mjcf.write_scene(scene, world.with_name("again.xml"))
    again = mjcf.load_world(world.with_name("again.xml"))
    points = np.random.default_rng(1).uniform((6, 2, 0.5), (16, 8, 6), (200, 3)).astype(np.float32)
    before, after = (mujoco_distance.distances(file, points) for file in (world, again.path))
    for ours, theirs in zip(("table", "egg", "again"), ("mesh1", "mesh2", "mesh3"), strict=True):
        np.testing.assert_allclose(before[ours], after[theirs], atol=1e-4)
    np.testing.assert_allclose(scene.others["fields"].albedo, again.scene.others["fields"].albedo, atol=1e-6)


def test_it_is_drawn_in_figures_and_on_the_page(world: Path) -> None:
    scene = mjcf.load_scene(world)
    solid = solids_of(scene)[0]
    away = np.abs(solid.corners - np.asarray(scene.others["fields"].position[0])).max(0)
    np.testing.assert_allclose(away, np.asarray(SHAPES.get("fields").reach(scene.others["fields"]))[0], atol=1e-3)
    assert [shape["kind"] for shape in world_data(scene)["shapes"]] == ["faces"] * 3


@pytest.mark.whole
def test_where_many_triangles_move_fewer_are_drawn_and_on_the_page_all(tmp_path: Path) -> None:
    scene = mjcf.load_scene(mesh_world(tmp_path, '<geom type="mesh" mesh="m" pos="9 5 3"/>', m=ball(300)))
    (solid,) = solids_of(scene)
    assert len(solid.faces) <= 400 and 0.9 < np.linalg.norm(solid.corners - [9, 5, 3], axis=1).min() < 1.01
    (drawn,) = world_data(scene)["shapes"]
    assert drawn["kind"] == "mesh" and len(drawn["triangles"]) == len(ball(300)[1]) > 400


@pytest.mark.whole
def test_pools_hold_worlds_with_and_without_meshes_and_with_others(world: Path, tmp_path: Path) -> None:
    some, plain = mjcf.load_scene(world), boxes_only(tmp_path)
    other = mjcf.load_scene(mesh_world(tmp_path, EGG.replace("9 4 4", "5 5 3"), egg=egg()))
    pool = stack_scenes([plain, other, some])
    assert [len(scene_shapes(take_scene(pool, i))) for i in range(3)] == [2, 2, 4]
    a, b = with_equal_capacities([stack_scenes([plain, other]), stack_scenes([some])])
    assert jax.tree.structure(a) == jax.tree.structure(b)
    near = jnp.array([5.0, 5.0, 4.5])
    ask = jax.jit(lambda scene: shape_distances(scene, near)["fields"])
    expected = float(shape_distances(other, near)["fields"][0])
    assert np.all(np.asarray(ask(take_scene(a, 0))) > 1e5)
    np.testing.assert_allclose(np.sort(ask(take_scene(a, 1)))[0], expected, rtol=1e-6)
    np.testing.assert_allclose(
        np.sort(ask(take_scene(b, 0))), np.sort(shape_distances(some, near)["fields"]), rtol=1e-6
    )


@pytest.mark.parametrize(
    ("geom", "mesh", "says"),
    [
        (TABLE, (BOARD[0], BOARD[1][1:]), "geom 'table': the mesh is not watertight"),
        (TABLE, (BOARD[0], BOARD[1][:, ::-1]), "geom 'table': the mesh is inside out"),
        (TABLE, (np.full((8, 3), np.nan), BOARD[1]), "is not an MJCF that MuJoCo can read: .* is not finite"),
    ],
)
def test_a_mesh_that_cannot_be_flown_is_refused_by_the_name_of_its_geom(
    tmp_path: Path, geom: str, mesh: tuple[np.ndarray, np.ndarray], says: str
) -> None:
    file = mesh_world(tmp_path, geom.replace('mesh="board"', 'mesh="m"'), m=mesh)
    with pytest.raises(SceneError, match=says) as raised:
        mjcf.load_scene(file)
    assert "\n" not in str(raised.value)


def test_meshes_that_are_too_many_together_are_refused(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(geoms, "MOST_VALUES", 30_000)
    with pytest.raises(SceneError, match="the grids of its meshes hold more than 30,000 values"):
        mjcf.load_scene(world)
