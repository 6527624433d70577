"""Worlds from files that move: what every word means, that nothing is lost in a file, and what is refused."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.sim.scene.mjcf import check_scene, load_world, mjcf_of, write_scene
from edqn_jax.sim.scene.mjcf_parts.files import SceneError
from edqn_jax.sim.scene.scene import PARKED, scene_at, scene_shapes, take_scene
from edqn_jax.sim.worlds.families import random_pool, world_keys
from edqn_jax.sim.worlds.moving import Moving

SITES = """
<site name="start" pos="2 10 5"/> <site name="goal" pos="38 10 5"/>
<site name="volume" type="box" pos="20 10 5" size="20 10 5"/>
<geom type="plane" size="0 0 1"/>
"""
BOX = '<body name="it" mocap="true" pos="20 10 2"><geom name="door" type="box" size="1 .5 2"/></body>'
BALL = '<body name="it" mocap="true" pos="20 10 2"><geom name="ball" type="sphere" size=".4"/></body>'


@pytest.fixture
def world_of(tmp_path):
    def load(data: str, body: str = BOX, name: str = "motion:it", sites: str = SITES):
        text = f'<custom><text name="{name}" data="{data}"/></custom>'
        file = tmp_path / "world.xml"
        file.write_text(f"<mujoco>{text}<worldbody>{sites}{body}</worldbody></mujoco>")
        return load_world(file)

    return load


@jax.jit
def places(scene, times):
    now = jax.vmap(lambda t: scene_at(scene, t))(times)
    return {kind: getattr(now, kind).position for kind in ("boxes", "cylinders", "spheres", "capsules")}


def moved(world, *times: float, kind: str = "boxes") -> np.ndarray:
    """[times, 3] of the only shape of a kind, less where the file has it."""
    return np.asarray(places(world.scene, jnp.float32(times))[kind])[:, 0] - np.array([20.0, 10.0, 2.0])


def test_what_oscillates_moves_by_its_amplitude_once_in_a_period(world_of):
    found = moved(world_of("oscillate 0 2 0.5 4 0"), 0, 1, 2, 3, 4)
    np.testing.assert_allclose(found, np.outer([0, 1, 0, -1, 0], [0, 2, 0.5]), atol=1e-5)
    # A quarter of a period later it begins at the end of its way.
    np.testing.assert_allclose(moved(world_of("oscillate 0 2 0 4 .25"), 0, 2)[:, 1], [0, -4], atol=1e-5)


def test_what_circles_goes_around_a_middle_anticlockwise(world_of):
    # At phase 0 the middle is 3 m in -x of it.
    found = moved(world_of("circle 3 8 0"), 0, 2, 4, 6)
    np.testing.assert_allclose(found, [[0, 0, 0], [-3, 3, 0], [-6, 0, 0], [-3, -3, 0]], atol=1e-5)
    np.testing.assert_allclose(moved(world_of("circle 3 -8 0"), 2), [[-3, -3, 0]], atol=1e-5)
    np.testing.assert_allclose(moved(world_of("circle 3 8 .5"), 2), [[3, -3, 0]], atol=1e-5)


def test_what_bounces_turns_where_it_would_leave_the_volume_or_at_its_limits(world_of):
    # The box reaches 1 m to either side: it may move from x = 1 to 39 and from y = 0.5 to 19.5.
    found = moved(world_of("bounce 2 -1 0"), 0, 5, 9.5, 10, 15)
    np.testing.assert_allclose(found[:, 0], [0, 10, 19, 18, 8], atol=1e-4)
    np.testing.assert_allclose(found[:, 1], [0, -5, -9.5, -9, -4], atol=1e-4)
    limited = moved(world_of("bounce 2 0 0 18 0 0 23 0 0"), 0, 1, 2, 3)
    np.testing.assert_allclose(limited[:, 0], [0, 2, 2, 0], atol=1e-4)


def test_a_bounce_and_a_circle_add(world_of):
    both, one, other = (moved(world_of(d), 3.3) for d in ("bounce 2 0 0; circle 1 5 0", "bounce 2 0 0", "circle 1 5 0"))
    np.testing.assert_allclose(both, one + other, atol=1e-5)


def test_all_shapes_of_a_body_and_of_its_children_move_together(world_of):
    cart = """
    <body name="it" mocap="true" pos="20 10 2" euler="0 0 90">
      <geom type="box" size="1 .5 1"/> <geom type="sphere" size=".5" pos="3 0 1"/>
      <body pos="0 0 2"><geom type="capsule" size=".2 .4" euler="30 0 0"/></body>
    </body>
    """
    world = world_of("bounce 0 3 0", cart)
    at = places(world.scene, jnp.float32([0.0, 1.0, 3.0]))
    for kind in ("boxes", "spheres", "capsules"):
        # The ball ahead, at y = 13.5 at most, meets the face at 20 after 6.5 m of way.
        np.testing.assert_allclose(at[kind][:, 0] - at[kind][0, 0], [[0, 0, 0], [0, 3, 0], [0, 4, 0]], atol=1e-4)
    assert world.names["spheres"] and world.scene.planes.position.shape == (1, 3)


def test_a_ball_is_thrown_at_the_files_own_drone(world_of):
    world = world_of("throw .5 2 6 30 0 0 4", BALL)
    at = places(world.scene, jnp.float32([0.0, 2.4, 2.6, 4.5]))["spheres"][:, 0]
    assert (np.abs(at[:2]) == PARKED).all() and np.abs(at[2]).max() < 40
    np.testing.assert_allclose(at[3], [20, 10, 5], atol=1e-4)  # halfway, after 18 m at 4 m/s
    comes = np.asarray(at[2]) - np.asarray(at[3])
    np.testing.assert_allclose(np.degrees(np.arctan2(comes[1], comes[0])), 30, atol=1e-2)
    check_scene(world.scene, 0.36)


@pytest.mark.whole
@pytest.mark.slow
def test_a_moving_random_world_survives_being_written(tmp_path):
    pool = random_pool("medium", world_keys("test", 2), Moving(share=0.8, balls=3, ball_gravity_m_s2=3.0))
    scene, times = take_scene(pool, 1), jnp.float32([0.0, 1.7, 6.3, 9.9, 31.0])
    write_scene(scene, tmp_path / "moving.xml", title="moving")
    world = load_world(tmp_path / "moving.xml")
    ours, theirs = places(scene, times), places(world.scene, times)
    for kind in ours:
        # Parked places are left out of the file.
        there = [
            np.asarray(x)[:, np.abs(np.asarray(x)).min(axis=(0, 2)) < PARKED / 2] for x in (ours[kind], theirs[kind])
        ]
        assert there[0].shape == there[1].shape
        # MuJoCo puts geoms of the world before those of bodies.
        apart = np.abs(there[0][:, :, None] - there[1][:, None]).max(axis=(0, 3), initial=0)
        assert apart.min(axis=1, initial=1).max(initial=0) < 2e-4, kind
    assert np.abs(np.asarray(ours["spheres"][2])[-3:]).min() < PARKED  # a ball is in flight
    assert sum(getattr(shape, "motion", None) is not None for shape in scene_shapes(world.scene)) > 10
    assert mjcf_of(world.scene, title="moving").count("<text ") == (tmp_path / "moving.xml").read_text().count("<text ")


def test_a_still_world_has_no_text_and_no_body():
    text = mjcf_of(take_scene(random_pool("sparse", world_keys("test", 1)), 0))
    assert "mocap" not in text and "custom" not in text


@pytest.mark.parametrize(
    ("data", "body", "said"),
    [
        ("wobble 1 2 3", BOX, "must begin with bounce, oscillate, circle, ellipse, throw, not 'wobble 1 2 3'"),
        ("oscillate 0 2 0", BOX, "must have 5 numbers after 'oscillate', not '0 2 0'"),
        ("bounce 1 0", BOX, "must have 3 or 9 numbers after 'bounce', not '1 0'"),
        ("oscillate 0 two 0 4 0", BOX, "must have 5 numbers after 'oscillate', not '0 two 0 4 0'"),
        ("oscillate 0 nan 0 4 0", BOX, "must have 5 numbers after 'oscillate'"),
        ("oscillate 0 2 0 0 0", BOX, "must have a period that is not 0"),
        ("circle 1 4 0; oscillate 0 2 0 4 0", BOX, "must be one motion, or a bounce and another one"),
        ("throw .5 2 6 0 0 0 4; bounce 1 0 0", BALL, "must be one motion, or a bounce and another one"),
        ("throw .5 0 6 0 0 0 4", BALL, "must have a share of 0 or more, and EARLY, SPEED and PACE above 0"),
        ("throw .5 .2 6 0 0 0 4", BALL, "must begin 1.5 m away or further: EARLY times SPEED"),
        ("throw .5 2 6 0 0 0 4", BOX, "the body 'it' is thrown and must be one sphere"),
        ("oscillate 0 90 0 1 0", BOX, "the body 'it' moves at 565 m/s; an obstacle may move at 100"),
        ("bounce 0 0 1", BOX.replace('size="1 .5 2"', 'size="1 .5 6"'), "bounces and must be within the flight volume"),
        ("bounce 1 0 0 21 0 0 30 0 0", BOX, "bounces and must be between its lowest and its highest position"),
        ("bounce 1 0 0", '<body name="it" mocap="true"/>', "the body 'it' moves and has no solid geom"),
        (
            "bounce 1 0 0",
            BOX.replace("<geom", '<geom type="plane" size="1 1 1"/><geom'),
            "has a plane, which has no end",
        ),
        ("bounce 1 0 0", BOX.replace("it", "other"), "the text 'motion:it' must name a body with mocap"),
        ("bounce 1 0 0", BOX.replace(' mocap="true"', ""), "the text 'motion:it' must name a body with mocap"),
    ],
)
def test_what_cannot_move_so_is_refused_in_one_sentence(world_of, data, body, said):
    with pytest.raises(SceneError) as raised:
        world_of(data, body)
    assert said in str(raised.value) and "\n" not in str(raised.value) and "world.xml" in str(raised.value)


def test_a_mocap_body_of_which_nothing_is_said_is_refused_with_an_example(world_of):
    with pytest.raises(
        SceneError, match="geom 'door' is on a body that can move; .* of body 'it', or say how it moves"
    ) as e:
        world_of("none", name="remark")
    assert '<text name="motion:it" data="oscillate 0 2 0 4 0"/>' in str(e.value)
    child = '<body name="it" mocap="true"><body><geom name="door" size="1"/></body></body>'
    with pytest.raises(SceneError, match="geom 'door' is on a body that can move"):
        world_of("none", child, name="remark")


def test_a_body_that_bounces_needs_a_volume_or_limits(world_of):
    without = '<site name="start" pos="2 10 5"/> <site name="goal" pos="38 10 5"/>'
    with pytest.raises(SceneError, match="bounces within the flight volume, which the file does not name; add a site"):
        world_of("bounce 1 0 0", sites=without)
    assert world_of("bounce 1 0 0 18 0 0 23 0 0", sites=without).scene.boxes.motion is not None
