"""Obstacles that move, as figures, GIFs, pictures of the camera and the page show them."""

# pyright: reportArgumentType=false

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.learn.policy import fresh_policy
from edqn_jax.report.page.worlds import ball_data, world_data
from edqn_jax.report.sights import FlightRenderer, decision_rows, times_of, trajectory_poses
from edqn_jax.report.worlds.flights import plot_path, plot_world
from edqn_jax.report.worlds.solids import make_cutaway, moving_solids, solids_of, static_scene
from edqn_jax.report.worlds.views import MAP
from edqn_jax.sim.actions import move_number
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.motion import Motion, Throw
from edqn_jax.sim.scene.scene import PARKED, Planes, Scene, Spheres, UprightBoxes, build_scene, stack_scenes
from edqn_jax.sim.sensors import event_field
from edqn_jax.sim.task import env
from edqn_jax.sim.task.missions import own_missions
from tests.support.box_flight import SMALL, Drawn, a_flight, recorded
from tests.support.meshes import bracket, mesh_world

RED, GREY = np.array([0.9, 0.05, 0.05]), np.full(3, 0.5)
SLIDING = Motion((0, 4, 0), (0, -9, 0), (0, 9, 0), np.zeros((2, 3)), 0.0)


def moving_world() -> Scene:
    """A red box that slides, one that stands, and a ball that is thrown."""
    return build_scene(
        [
            UprightBoxes([12.0, -6, 4], [1.5, 1.5, 4], 0.0, RED, motion=SLIDING),
            UprightBoxes([24.0, 5, 4], [1, 1, 4], 0.3, GREY),
            Planes(np.zeros(3), np.array([0, 0, 1.0]), GREY),
            Spheres(np.full(3, PARKED), 0.4, RED, throw=Throw(0.5, 1.5, 6.0, 0.3, 0.2, 5.0, 4.0)),
        ],
        volume=[[-9, -9, 0], [40, 9, 20]],
        start=[0, 0, 4],
        goal=[30, 0, 4],
    )


def test_solids_that_move_are_where_they_are_at_a_time_and_the_others_stand():
    scene = moving_world()
    assert len(solids_of(static_scene(scene))) == 1
    for time, middle in ((0.0, -6.0), (1.5, 0.0), (4.0, 8.0)):
        box = moving_solids(scene, time)[0]
        np.testing.assert_allclose(box.corners.mean(0), [12, middle, 4], atol=1e-4)
    # The ball meets the drone at 15 m, after 3.75 s, and is thrown 1.5 s before.
    assert [len(moving_solids(scene, time)) for time in (2.0, 3.0, 30.0)] == [1, 2, 1]


def test_a_mesh_that_moves_is_drawn_and_shown_on_the_page_where_it_is(tmp_path):
    vertices, faces = bracket()
    geom = '<body name="b" mocap="true" pos="9 5 3" euler="0 0 90"><geom type="mesh" mesh="m"/></body>'
    text = '<custom><text name="motion:b" data="oscillate 0 2 0 4 0"/></custom>'
    file = mesh_world(tmp_path, geom, m=(vertices, faces))
    file.write_text(file.read_text().replace("</mujoco>", text + "</mujoco>"))
    scene = load_scene(file)
    assert solids_of(static_scene(scene)) == []
    turned = vertices @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    for time, away in ((0.0, 0.0), (1.0, 2.0), (3.0, -2.0)):
        corners = np.concatenate([solid.corners for solid in moving_solids(scene, time)]) - [9, 5 + away, 3]
        for edge in (np.min, np.max):  # parts are made of cells of 0.1 m
            np.testing.assert_allclose(edge(corners, axis=0), edge(turned, axis=0), atol=0.11)
    (shown,) = world_data(scene)["shapes"]
    assert shown["kind"] == "mesh" and shown["moves"]["swing"][1] == [0, 2, 0] and "closes" not in shown
    place = np.reshape(shown["turn"], (3, 3)) @ np.transpose(shown["vertices"]) + np.reshape(shown["at"], (3, 1))
    np.testing.assert_allclose(np.ptp(place, axis=1), np.ptp(turned, axis=0), atol=2e-3)


def test_a_still_picture_outlines_what_moves_and_says_so(tmp_path):
    world = make_cutaway(moving_world(), MAP)
    assert len(world.shown) == 1 and len(world.moving) == 1
    assert "outlined: what moves, as at the start" in plot_world(moving_world(), tmp_path / "world.png").axes[
        0
    ].get_title("left")
    flown = plot_path(moving_world(), a_flight(4), None, tmp_path / "path.png")
    assert all("outlined: what moves" in axes.get_title("left") for axes in flown.axes[:2])
    assert make_cutaway(static_scene(moving_world()), MAP).note == ""


def red_middle(gif, frame: int) -> np.ndarray:
    """Mean row and column of the red pixels of the map, below the right."""
    gif.seek(frame)
    picture = np.asarray(gif.convert("RGB")).astype(int)[300:, 350:580]
    red = (picture[..., 0] > 90) & (picture[..., 1:].max(-1) < 60)
    return np.argwhere(red).mean(0)


@pytest.mark.slow
def test_an_animation_shows_obstacles_where_they_are_at_each_moment():
    class Moving(Drawn):
        scene = moving_world()

    gif = recorded(Moving(), 7)
    first, last = red_middle(gif, 0), red_middle(gif, 6)
    # On the map y points up; 4 m/s for 1.56 s, and no way along x.
    assert first[0] - last[0] > 15 and abs(first[1] - last[1]) < 4


@pytest.mark.slow
def test_the_pictures_of_a_flight_are_those_that_the_drone_saw():
    scene = moving_world()
    pool = stack_scenes([scene])
    world = env.EnvParams(load_airframe(SMALL.drone), pool, own_missions(pool))
    state, _ = env.reset(SMALL, world, jax.random.key(3), jnp.asarray(0))
    actions = jnp.full(5, move_number("hover"))
    step = lambda state, action: env.step(SMALL, world, state, action)  # noqa: E731
    _, steps = jax.jit(lambda state: jax.lax.scan(step, state, actions))(state)
    whole = [steps.flight.position, steps.flight.quaternion, steps.flight.velocity]
    names = ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz")
    flown = dict(zip(names, np.concatenate(whole, -1).reshape(-1, 10).T, strict=True))
    flown["t"] = SMALL.drone.physics_dt_s * np.arange(1, len(flown["x"]) + 1)
    flown["action"] = np.repeat(actions, SMALL.drone.physics_steps)
    with ThreadPoolExecutor(2) as threads:
        sights = FlightRenderer(SMALL, scene, threads)
    seen = np.asarray(jax.vmap(event_field.event_image)(steps.observation.sensed))
    assert np.abs(seen).sum() > 100  # of the obstacle's own motion
    np.testing.assert_array_equal(sights.shown(fresh_policy(SMALL), flown).image, seen)
    rows = decision_rows(SMALL, flown)[:, -1]
    one, other = (sights.rgb(*trajectory_poses(flown, row), times_of(flown, row)) for row in rows[[0, -1]])
    assert np.abs(one - other).max() > 0.2


def test_the_page_knows_how_shapes_move():
    world = world_data(moving_world())
    box, still = world["shapes"]
    (ball,) = ball_data(moving_world())
    assert box["moves"]["velocity"] == [0, 4, 0] and box["moves"]["high"] == [0, 9, 0] and "closes" not in box
    assert "moves" not in still
    moves = ball["moves"]
    assert (moves["hit"], moves["early"], moves["speed"], moves["aim"]) == (3.75, 1.5, 6.0, [15, 0, 4])
    turned = [np.cos(0.2) * np.cos(0.3), np.cos(0.2) * np.sin(0.3), np.sin(0.2)]
    np.testing.assert_allclose(moves["from"], turned, atol=1e-5)
    assert not any("moves" in shape for shape in world_data(static_scene(moving_world()))["shapes"])
