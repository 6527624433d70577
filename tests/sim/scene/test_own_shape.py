"""A kind of shape that the package does not have, the how-to's ellipsoid: loaded, flown, seen, drawn, written."""

# pyright: reportArgumentType=false

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
from edqn_jax.report.worlds.solids import make_cutaway, plot_solids, solids_of
from edqn_jax.report.worlds.views import MAP
from edqn_jax.sim.camera import camera, native
from edqn_jax.sim.scene import mjcf
from edqn_jax.sim.scene.distance import path_contact, shape_distances
from edqn_jax.sim.scene.scene import (
    Scene,
    obstacle_count,
    scene_at,
    scene_shapes,
    stack_scenes,
    take_scene,
    with_equal_capacities,
)
from edqn_jax.sim.worlds.reachability import has_way
from tests.oracles import mujoco_distance
from tests.support.pages import ROOT, blocks_of, empty_module
from tests.support.registries import keep_as_they_are

PAGE = ROOT / "docs/howto/own_shape.md"
RADIUS = 0.36
CONFIG = CameraConfig(width=16, height=12)


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The page's file, once the page's kind is registered."""
    keep_as_they_are(monkeypatch)
    exec(blocks_of(PAGE, "python")[0], empty_module("own_shape", monkeypatch))
    file = tmp_path / "mine.xml"
    file.write_text(blocks_of(PAGE, "xml")[0], encoding="utf-8")
    return file


def plain(tmp_path: Path) -> Scene:
    """A world without the kind."""
    file = tmp_path / "plain.xml"
    sites = '<site name="start" pos="1 1 1"/><site name="goal" pos="9 9 1"/>'
    file.write_text(f'<mujoco><worldbody>{sites}<geom type="box" size="1 1 1" pos="5 5 1"/></worldbody></mujoco>')
    return mjcf.load_scene(file)


def test_its_distance_is_mujocos_outside(world: Path) -> None:
    scene = mjcf.load_scene(world)
    points = np.random.default_rng(0).uniform((8, 3, 0), (22, 17, 9), (200, 3)).astype(np.float32)
    ours = np.asarray(jax.jit(jax.vmap(lambda p: shape_distances(scene, p)["ellipsoids"][0]))(points))
    theirs = mujoco_distance.distances(world, points)["egg"]
    outside = theirs > 0.01
    assert 50 < outside.sum() < 200
    np.testing.assert_allclose(ours[outside], theirs[outside], atol=1e-3)
    assert np.all(ours[theirs < -0.05] < 0)


def test_a_drone_that_flies_into_it_collides_where_the_judge_says(world: Path) -> None:
    path = np.linspace((9.0, 9.5, 4.3), (16.0, 10.5, 3.8), 50)
    touch, fraction = jax.jit(path_contact)(mjcf.load_scene(world), jnp.asarray(path, jnp.float32), RADIUS)
    contact = replay_contact(load_judge(world, RADIUS), path)
    assert contact is not None and contact.geom == "egg" and np.asarray(touch).sum() == 1
    step = np.linalg.norm(path[1] - path[0])
    first = int(np.argmax(touch))
    assert abs(first + float(fraction[first]) - contact.segment - contact.fraction) * step < 0.01


@pytest.mark.parametrize("mount", ["level", "body"])
def test_the_camera_sees_it_as_mujoco_does(world: Path, mount: Any) -> None:
    scene, config = mjcf.load_scene(world), dataclasses.replace(CONFIG, mount=mount)
    assert not native.can_render(scene, "cpu")  # C knows built-in kinds alone
    position, ahead = jnp.array([7.0, 10.0, 5.0]), jnp.eye(3)
    depth = np.asarray(jax.jit(partial(camera.render_depth, config, scene))(position, ahead))
    model = mujoco.MjModel.from_xml_path(str(world))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    is_egg = np.zeros(depth.shape, bool)
    for row, v in enumerate(0.75 * (1 - 2 * (np.arange(12) + 0.5) / 12)):
        for column, u in enumerate(2 * (np.arange(16) + 0.5) / 16 - 1):
            way, geom = np.array([1.0, -u, v]), np.zeros(1, np.int32)
            theirs = mujoco.mj_ray(model, data, np.array(position), way / np.linalg.norm(way), None, 1, -1, geom)
            if theirs > 0 and model.geom(geom[0]).name == "egg":
                np.testing.assert_allclose(depth[row, column], theirs, rtol=1e-4)
                is_egg[row, column] = True
    assert is_egg.sum() > 20
    luma = np.asarray(jax.jit(partial(camera.render_luma, config, scene))(position, ahead))
    without = mjcf.load_scene(world).with_shapes(
        {"ellipsoids": jax.tree.map(lambda x: x[:0], scene.others["ellipsoids"])}
    )
    changed = np.abs(luma - np.asarray(jax.jit(partial(camera.render_luma, config, without))(position, ahead))) > 1e-3
    assert changed[is_egg].mean() > 0.9 and (changed & ~is_egg).sum() < 40  # those of its edge


def test_the_normal_where_a_ray_meets_it_points_away_from_its_surface(world: Path) -> None:
    scene = mjcf.load_scene(world)
    origin, way = jnp.array([7.0, 9.0, 5.0]), jnp.array([1.0, 0.1, -0.1])
    met = SHAPES.get("ellipsoids").meet(scene.others["ellipsoids"], origin, tuple(way[:, None, None, None]))
    point = origin + met.depth[0, 0, 0] * way
    steps = 0.05 * np.eye(3, dtype=np.float32)
    gap = jax.jit(lambda p: shape_distances(scene, p)["ellipsoids"][0])
    slope = np.array([float(gap(point + step) - gap(point - step)) for step in steps]) / 0.1
    assert bool(met.hit[0, 0, 0]) and abs(float(gap(point))) < 1e-3
    np.testing.assert_allclose([float(part[0, 0, 0]) for part in met.normal], slope, atol=0.02)


def test_what_is_written_loads_back(world: Path) -> None:
    scene = mjcf.load_scene(world)
    mjcf.write_scene(scene, world.with_name("again.xml"))
    again = mjcf.load_scene(world.with_name("again.xml"))
    assert again.others.keys() == {"ellipsoids"} and obstacle_count(again) == 1
    for here, there in zip(jax.tree.leaves(scene), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(here, there, atol=1e-5)


def test_it_is_drawn_in_figures_and_on_the_page(world: Path) -> None:
    from matplotlib.figure import Figure

    scene = mjcf.load_scene(world)
    (solid,) = solids_of(scene)
    radii = np.linalg.norm(solid.corners - np.array([15, 10, 4]), axis=1)
    assert 1.9 < radii.min() < 2.1 and 3.8 < radii.max() < 4.01
    plot_solids(Figure().add_subplot(), MAP, make_cutaway(scene, MAP).shown)
    (shape,) = world_data(scene)["shapes"]
    assert shape["kind"] == "faces" and shape["at"] == [15, 10, 4] and len(shape["faces"]) == len(solid.faces)


def test_it_moves_and_the_judge_turns_it_back_at_the_same_wall(world: Path) -> None:
    text = world.read_text(encoding="utf-8").replace(
        "<geom name", '<body name="b" mocap="true" pos="15 10 5"><geom name'
    )
    text = text.replace('pos="15 10 4"', "").replace("</worldbody>", "</body></worldbody>")
    said = '<custom><text name="motion:b" data="bounce 4 0 0"/></custom></mujoco>'
    world.write_text(text.replace("</mujoco>", said), encoding="utf-8")
    scene, judge = mjcf.load_scene(world), load_judge(world, RADIUS)
    for time in (0.0, 3.0, 8.0, 12.0):
        here = scene_at(scene, jnp.float32(time)).others["ellipsoids"].position[0]
        np.testing.assert_allclose(here, judge.moving[0].at(time, judge.target), atol=1e-3)


def test_pools_hold_worlds_with_and_without_it(world: Path, tmp_path: Path) -> None:
    egg, box = mjcf.load_scene(world), plain(tmp_path)
    pool = stack_scenes([box, egg])
    assert [len(scene_shapes(take_scene(pool, i))) for i in range(2)] == [1, 2]
    boxes, eggs = with_equal_capacities([stack_scenes([box]), stack_scenes([egg])])
    assert jax.tree.structure(boxes) == jax.tree.structure(eggs)
    assert [len(scene_shapes(take_scene(each, 0))) for each in (boxes, eggs)] == [1, 2]
    far = shape_distances(take_scene(boxes, 0), jnp.zeros(3))["ellipsoids"]
    assert np.all(np.asarray(far) > 1e5)


def test_it_may_block_the_only_way(world: Path) -> None:
    open_, text = mjcf.load_scene(world), world.read_text(encoding="utf-8")
    size = (40.0, 20.0, 12.0)
    assert bool(has_way(open_, size, RADIUS, 0.5))
    world.write_text(text.replace('size="2 3 4"', 'size="4 30 30"').replace('euler="20 0 30"', ""), encoding="utf-8")
    assert not bool(has_way(mjcf.load_scene(world), size, RADIUS, 0.5))


@pytest.mark.whole
def test_without_the_kind_it_is_a_field(tmp_path: Path) -> None:
    file = tmp_path / "egg.xml"
    file.write_text(blocks_of(PAGE, "xml")[0], encoding="utf-8")
    assert mjcf.load_world(file).names["fields"] == ("egg",)
