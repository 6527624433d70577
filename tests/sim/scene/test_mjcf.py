"""Reading and writing worlds as MJCF, and the messages for invalid worlds."""

# pyright: reportArgumentType=false
# Single shapes are written with plain numbers here.

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from edqn_jax.config import FAMILIES
from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene import mjcf
from edqn_jax.sim.scene.distance import shape_distances, signed_distance
from edqn_jax.sim.scene.mjcf import (
    VOLUME_MARGIN,
    SceneError,
    check_scene,
    load_scene,
    load_world,
    resolve_world,
    scenes_folder,
    write_scene,
)
from edqn_jax.sim.scene.scene import (
    Capsules,
    Planes,
    Spheres,
    TiltedBoxes,
    TiltedCylinders,
    UprightBoxes,
    UprightCylinders,
    build_scene,
    obstacle_count,
    scene_shapes,
)
from edqn_jax.sim.worlds.families import random_scene, world_key
from tests.support.meshes import LUMP

RADIUS = 0.36
GREY = np.full(3, 0.5)
ENDS = '<site name="start" pos="0 0 5"/><site name="goal" pos="9 0 5"/>'


@pytest.fixture
def world_of(tmp_path):
    """Loads the world whose world body has this content."""

    def load(content: str, preamble: str = ""):
        path = tmp_path / "world.xml"
        path.write_text(f"<mujoco>{preamble}<worldbody>{content}</worldbody></mujoco>")
        return load_world(path)

    return load


@pytest.fixture(scope="module")
def paper():
    return load_world(resolve_world("paper"))


# ---------------------------------------------------------------------------------------- the paper's


def test_the_papers_world_is_what_the_paper_says(paper):
    scene = paper.scene
    np.testing.assert_allclose(scene.volume, [[0, 0, 0], [110, 110, 25]], atol=1e-5)
    np.testing.assert_array_equal(scene.start, [1, 1, 3])
    np.testing.assert_array_equal(scene.goal, [90, 90, 10])
    assert 28 <= len(paper.names["boxes"]) <= 32 and paper.names["spheres"] == ("ball",)
    assert not paper.names["tilted_boxes"]  # a level camera is at its fastest among upright boxes
    spread = np.ptp(np.asarray(scene.boxes.albedo), axis=1)
    assert spread.max() < 0.06  # grey
    red, green, blue = np.asarray(scene.spheres.albedo[0])
    assert red > 0.8 and green > 0.6 and blue < 0.3  # yellow
    check_scene(scene, RADIUS, names=paper.names)


def test_the_papers_straight_line_is_blocked_more_than_twice(paper):
    points = paper.scene.start + jnp.linspace(0, 1, 5000)[:, None] * (paper.scene.goal - paper.scene.start)
    inside = jax.jit(jax.vmap(lambda p: shape_distances(paper.scene, p)))(points)
    blocking = sum(int((np.asarray(d).min(axis=0) < 0).sum()) for d in inside.values())
    assert blocking >= 3


def test_the_papers_start_and_goal_stand_free_and_its_streets_are_wide_enough(paper):
    for point in (paper.scene.start, paper.scene.goal):
        assert signed_distance(paper.scene, point) >= 2.5
    model = mujoco.MjModel.from_xml_path(str(paper.path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    solid = [geom for geom in range(model.ngeom) if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE]
    gaps = [mujoco.mj_geomDistance(model, data, a, b, 50.0, None) for a in solid for b in solid if a < b]
    # Either two metres of air or a metre of overlap: nothing for the drone to be stuck in.
    assert all(gap >= 2.0 or gap <= -1.0 for gap in gaps)


# --------------------------------------------------------------------------------------- the loader


def test_a_box_is_upright_whichever_of_its_axes_is(world_of):
    world = world_of(
        ENDS
        + '<geom name="a" type="box" size="1 2 3" pos="4 0 0" euler="0 0 30"/>'
        + '<geom name="b" type="box" size="1 2 3" pos="4 9 0" euler="90 0 0"/>'
        + '<geom name="c" type="box" size="1 2 3" pos="4 -9 0" euler="0 90 0"/>'
        + '<geom name="d" type="box" size="1 2 3" pos="4 20 0" euler="0 1 0"/>'
    )
    assert world.names["boxes"] == ("a", "b", "c") and world.names["tilted_boxes"] == ("d",)
    np.testing.assert_allclose(world.scene.boxes.yaw[0], np.deg2rad(30), atol=1e-6)
    np.testing.assert_allclose(world.scene.boxes.half[:, 2], [3, 2, 1], atol=1e-6)


def test_shapes_on_welded_bodies_are_taken_where_they_stand(world_of):
    world = world_of(
        ENDS + '<body pos="1 2 3" euler="0 0 90"><body pos="5 0 0"><geom size="1" pos="1 0 0"/></body></body>'
    )
    np.testing.assert_allclose(world.scene.spheres.position, [[1, 8, 3]], atol=1e-5)
    assert world.names["spheres"] == ("geom number 0 (sphere)",)


def test_colour_is_the_materials_before_the_geoms(world_of):
    world = world_of(
        ENDS + '<geom size="1" rgba="1 0 0 1"/><geom size="1" pos="3 0 0" material="blue" rgba="1 0 0 1"/>',
        preamble='<asset><material name="blue" rgba="0 0 1 0.5"/></asset>',
    )
    np.testing.assert_array_equal(world.scene.spheres.albedo, [[1, 0, 0], [0, 0, 1]])


def test_only_what_is_neither_seen_nor_touched_is_left_out(world_of):
    world = world_of(
        ENDS
        + '<geom name="seen" size="1" contype="0" conaffinity="0"/>'
        + '<geom name="touched" size="1" group="3"/>'
        + '<geom name="neither" type="ellipsoid" size="1 2 1" group="3" contype="0" conaffinity="0"/>'
    )
    assert world.names["spheres"] == ("seen", "touched")
    assert obstacle_count(world.scene) == 2


def test_without_a_volume_it_is_the_box_around_shapes_and_sites_and_not_below_the_ground(world_of):
    world = world_of(ENDS + '<geom type="plane" size="0 0 1" pos="0 0 -2"/><geom type="box" size="1 1 1" pos="4 7 0"/>')
    lower = [0 - VOLUME_MARGIN, 0 - VOLUME_MARGIN, -2]
    upper = [9 + VOLUME_MARGIN, 8 + VOLUME_MARGIN, 5 + VOLUME_MARGIN]
    np.testing.assert_allclose(world.scene.volume, [lower, upper], atol=1e-5)


def test_a_named_volume_counts(world_of):
    world = world_of(ENDS + '<site name="volume" type="box" pos="5 0 5" size="10 20 5"/>')
    np.testing.assert_allclose(world.scene.volume, [[-5, -20, 0], [15, 20, 10]], atol=1e-5)


# ------------------------------------------------------------------------------------------- errors


def message(raised) -> str:
    """The message, which must be one sentence in one line."""
    text = str(raised.value)
    assert "\n" not in text and isinstance(raised.value, ConfigError)
    return text


def test_a_geom_that_cannot_be_taken_is_named(world_of):
    with pytest.raises(SceneError) as raised:
        world_of(ENDS + '<geom name="egg" type="sdf" mesh="lump"/>', f"<asset>{LUMP}</asset>")
    assert all(
        part in message(raised)
        for part in ("'egg'", "sdf", "world.xml", "make it a box, cylinder, sphere, capsule, plane or mesh")
    )


@pytest.mark.parametrize("joint", ["<freejoint/>", '<joint type="hinge"/>'])
def test_a_geom_that_can_move_is_named(world_of, joint):
    with pytest.raises(SceneError) as raised:
        world_of(ENDS + f'<body name="lift">{joint}<geom name="door" size="1"/></body>')
    assert "'door'" in message(raised) and "'lift'" in message(raised)


def test_a_mocap_body_counts_as_moving(world_of):
    with pytest.raises(SceneError, match="'door' is on a body that can move"):
        world_of(ENDS + '<body name="lift" mocap="true"><geom name="door" size="1"/></body>')


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ('<geom name="door" type="box" pos="nan 0 5" size="2 2 5"/>', "geom 'door' has a place or a size that is not"),
        ('<geom name="door" type="box" pos="20 0 5" size="2 inf 5"/>', "geom 'door' has a place or a size that is not"),
        ('<site name="gate" pos="0 nan 2"/>', "the site 'gate' stands at no finite point"),
    ],
)
def test_what_is_not_finite_is_named(world_of, content, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning into a file there
    with pytest.raises(SceneError, match=says):
        world_of(ENDS + content)


def test_a_volume_that_no_search_could_hold_is_refused(world_of):
    world = world_of(ENDS + '<site name="volume" type="box" size="1e6 9 9"/>')
    with pytest.raises(SceneError, match="is longer than 500 m"):
        check_scene(world.scene, RADIUS)


def test_a_turned_volume_is_refused(world_of):
    with pytest.raises(SceneError, match="'volume' must be a box that is not rotated"):
        world_of(ENDS + '<site name="volume" type="box" size="9 9 9" euler="0 0 10"/>')


@pytest.mark.parametrize("text", ["<mujoco><worldbody></mujoco>", "hello", "<mujoco><nonsense/></mujoco>"])
def test_a_file_that_does_not_parse_says_why_in_one_line(tmp_path, text):
    path = tmp_path / "broken.xml"
    path.write_text(text)
    with pytest.raises(SceneError) as raised:
        load_scene(path)
    assert "broken.xml" in message(raised)


@pytest.mark.parametrize(
    ("name", "hint"),
    [("papr", "; did you mean 'paper'?"), ("meduim", "; did you mean 'medium'?"), ("qqqq", "")],
)
def test_a_missing_scene_names_what_there_is_and_what_was_meant(name, hint, tmp_path, monkeypatch):
    monkeypatch.setattr(mjcf, "scenes_folder", lambda: tmp_path)
    for scene in ("paper", "alley"):
        (tmp_path / f"{scene}.xml").touch()
    with pytest.raises(SceneError) as raised:
        resolve_world(name)
    assert message(raised) == (
        f"there is no scene '{name}' in {tmp_path}; scenes known by name: alley, paper; "
        f"random worlds: {', '.join(FAMILIES)}{hint}"
    )


def test_a_missing_scene_file_names_the_folder_searched(tmp_path):
    with pytest.raises(SceneError) as raised:
        resolve_world(str(tmp_path / "nowhere.xml"))
    assert f"there is no scene file 'nowhere.xml' in {tmp_path}; scenes known by name: " in message(raised)
    with pytest.raises(SceneError, match="is a folder; give a MuJoCo file"):
        resolve_world(str(tmp_path))


def test_a_world_is_found_by_its_name_and_by_its_path():
    assert resolve_world("paper") == scenes_folder() / "paper.xml"
    assert resolve_world(str(scenes_folder() / "paper.xml")) == scenes_folder() / "paper.xml"


@pytest.mark.parametrize("role", ["start", "goal"])
@pytest.mark.parametrize(
    ("point", "said"),
    [
        ([np.nan] * 3, ["add a site", "<site name="]),
        ([55.0, 120.0, 3.0], ["outside", "y = 120", "0 to 110"]),
        ([14.0, 14.0, 3.0], ["inside 'diagonal_1'"]),
        ([33.0, 34.2, 3.0], ["0.20 m from 'diagonal_2'", "0.36 m"]),
        ([20.0, 1.0, 0.1], ["'ground'"]),
    ],
)
def test_a_bad_start_or_goal_says_what_is_wrong(paper, role, point, said):
    scene = dataclasses.replace(paper.scene, **{role: jnp.array(point)})
    with pytest.raises(SceneError) as raised:
        check_scene(scene, RADIUS, names=paper.names)
    assert all(part in message(raised) for part in [role, *said])


def test_a_world_without_sites_loads_and_is_refused_only_when_flown(world_of):
    world = world_of('<geom size="1"/>')
    with pytest.raises(SceneError, match="does not say where its start is"):
        check_scene(world.scene, RADIUS)
    placed = dataclasses.replace(world.scene, start=jnp.array([3.0, 0, 0]), goal=jnp.array([-3.0, 0, 0]))
    check_scene(placed, RADIUS)


# ---------------------------------------------------------------------------------------- round trip


def assert_same_scene(ours, theirs):
    for name in ("volume", "start", "goal"):
        # Corners of the volume are written as middle and half size: a few units of the last digit.
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-4)
    for a, b in zip(scene_shapes(ours), scene_shapes(theirs), strict=True):
        assert type(a) is type(b)
        for field in dataclasses.fields(a):
            x, y = getattr(a, field.name), getattr(b, field.name)
            if x is None or y is None:  # of what moves
                assert x is y, field.name
                continue
            if field.name == "yaw":  # a box turned by half a turn is the same box
                x, y = np.sin(2 * x), np.sin(2 * y)
            np.testing.assert_allclose(x, y, rtol=1e-6, atol=2e-6, err_msg=field.name)


@pytest.mark.slow
def test_a_random_world_survives_being_written(tmp_path):
    scene = random_scene("sparse", world_key("test", 3))
    write_scene(scene, tmp_path / "random.xml", title="random")
    world = load_world(tmp_path / "random.xml")
    assert_same_scene(world.scene, scene)
    check_scene(world.scene, RADIUS, names=world.names)


def test_every_kind_survives_being_written(tmp_path):
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    axis = turn[:, 0]
    scene = build_scene(
        [
            UprightBoxes(position=[5, 5, 5], half=[1, 2, 3], yaw=0.7, albedo=[0.1, 0.2, 0.3]),
            TiltedBoxes(position=[1, 2, 8], half=[1, 2, 3], rotation=turn, albedo=GREY),
            Capsules(position=[2, 2, 2], axis=axis, half_length=1, radius=0.5, albedo=GREY),
            UprightCylinders(position=[5, 5, 5], radius=1, half_height=3, albedo=GREY),
            TiltedCylinders(position=[2, 8, 5], axis=axis, half_length=1, radius=1, albedo=GREY),
            Spheres(position=[5, 5, 5], radius=1, albedo=GREY),
            Planes(position=[0, 0, -1], normal=axis, albedo=GREY),
        ],
        volume=[[0, 0, 0], [10, 20, 30]],
        start=[1, 1, 1],
        goal=[9, 9, 9],
        capacities={"boxes": 3, "spheres": 2},
    )
    write_scene(scene, tmp_path / "all.xml")
    assert_same_scene(load_scene(tmp_path / "all.xml"), scene)


def test_a_camera_in_a_written_world_sees_its_solids_alone_and_all_that_the_body_may_come_near_to(tmp_path):
    """MuJoCo shows sites of the groups 0 to 2, and draws from `znear` times the model's extent on."""
    scene = build_scene([], volume=[[0, 0, 0], [10, 20, 30]], start=[1, 1, 1], goal=[9, 9, 9])
    write_scene(scene, tmp_path / "empty.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "empty.xml"))
    assert {model.site(number).name for number in range(model.nsite)} == {"start", "goal", "volume"}
    assert (model.site_group >= 3).all()
    assert 0 < model.vis.map.znear * model.stat.extent < RADIUS / 2
