"""The images along a flight are those that the drone's sensor showed."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import Config
from edqn_jax.learn.perception import vae
from edqn_jax.learn.policy import fresh_policy
from edqn_jax.report.sights import (
    FINE,
    FlightRenderer,
    decision_rows,
    downsample_picture,
    own_motions,
    start_poses,
    trajectory_poses,
)
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.camera import camera
from edqn_jax.sim.physics import drone
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene.scene import stack_scenes
from edqn_jax.sim.sensors import event_field, sensor
from edqn_jax.sim.task import env
from edqn_jax.sim.task.missions import own_missions
from edqn_jax.sim.task.observation import with_lean
from tests.support.box_flight import SMALL, world_with_a_box

HEIGHT, WIDTH = SMALL.camera.height, SMALL.camera.width
MOVES = [(1, 0, 0), (1, 0, 0), (1, 1, 0), (1, 0, 1), (1, -1, 0), (1, 0, 0)]


def sights_of(config: Config) -> FlightRenderer:
    with ThreadPoolExecutor(2) as threads:
        return FlightRenderer(config, world_with_a_box(), threads)


def fly(config: Config) -> tuple[dict[str, np.ndarray], env.Step]:
    """Returns a flight as the columns of a trajectory, and as the steps that the drone took."""
    pool = stack_scenes([world_with_a_box()])
    world = env.EnvParams(load_airframe(config.drone), pool, own_missions(pool))
    state, _ = env.reset(config, world, jax.random.key(3), jnp.asarray(0))
    actions = jnp.array([np.flatnonzero((ACTIONS == move).all(axis=1))[0] for move in MOVES])
    _, steps = jax.jit(lambda state: jax.lax.scan(partial(env.step, config, world), state, actions))(state)
    columns = (
        np.concatenate([steps.flight.position, steps.flight.quaternion, steps.flight.velocity], -1).reshape(-1, 10).T
    )
    names = ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz")
    flown: dict[str, np.ndarray] = dict(zip(names, columns, strict=True))
    flown["t"] = SMALL.drone.physics_dt_s * np.arange(1, columns.shape[1] + 1)
    flown["action"] = np.repeat(actions, SMALL.drone.physics_steps)
    return flown, steps


@pytest.fixture(scope="module")
def flight() -> tuple[dict[str, np.ndarray], env.Step]:
    return fly(SMALL)


@pytest.fixture(scope="module")
def sights() -> FlightRenderer:
    return sights_of(SMALL)


@pytest.mark.whole
@pytest.mark.slow
def test_the_events_are_those_that_the_drone_got(sights, flight):
    flown, steps = flight
    shown = sights.shown(fresh_policy(SMALL), flown)
    seen = np.asarray(jax.vmap(event_field.event_image)(steps.observation.sensed))
    assert np.abs(seen).sum() > 500
    np.testing.assert_array_equal(shown.image, seen)
    assert shown.target.shape == shown.reconstruction.shape == (len(MOVES), HEIGHT, WIDTH)
    assert shown.target.min() > -1e-5


@pytest.mark.whole
@pytest.mark.slow
def test_what_slow_photoreceptors_show_of_the_first_decision_follows_the_start():
    events = dataclasses.replace(SMALL.events, bandwidth_hz=8.0, threshold=0.003, tolerance=0.003)
    slow = dataclasses.replace(SMALL, events=events)
    flown, steps = fly(slow)
    shown = sights_of(slow).shown(fresh_policy(slow), flown)
    seen = np.asarray(jax.vmap(event_field.event_image)(steps.observation.sensed))
    assert np.abs(seen[0]).sum() > 100
    np.testing.assert_array_equal(shown.image, seen)


def test_a_flight_starts_at_rest_where_it_started(flight):
    flown, _ = flight
    position, quaternion, time = start_poses(SMALL, flown)
    world = world_with_a_box()
    assert position.shape == (1, 2, 3) and quaternion.shape == (1, 2, 4)
    np.testing.assert_allclose(position[0], np.broadcast_to(world.start, (2, 3)), atol=1e-5)
    np.testing.assert_allclose(quaternion[0], np.broadcast_to([1.0, 0, 0, 0], (2, 4)), atol=1e-4)
    np.testing.assert_allclose(time[0], SMALL.events.frame_times_s, atol=1e-6)


def test_own_motions_are_those_that_the_drone_knew(flight):
    flown, steps = flight
    motion = own_motions(SMALL, flown, decision_rows(SMALL, flown))
    # The yaw rate is the mean of the last 0.02 s, not that at their end.
    np.testing.assert_allclose(motion, steps.observation.motion, atol=0.02)
    np.testing.assert_allclose(
        motion[:, [0, 1, 2, 4, 5, 6]], steps.observation.motion[:, [0, 1, 2, 4, 5, 6]], atol=1e-5
    )
    assert np.abs(motion[:, 3]).max() > 0.01
    leaning = dataclasses.replace(SMALL, camera=dataclasses.replace(SMALL.camera, mount="body"))
    attitudes = jnp.asarray(trajectory_poses(flown, decision_rows(SMALL, flown))[1])
    lean = np.asarray(with_lean(leaning, attitudes, jnp.asarray(motion)))[:, 7:]
    assert lean.shape == (len(MOVES), 4) and np.abs(lean).max() > 0.01
    leant = drone.roll_and_pitch_of(steps.flight.quaternion[:, -1])
    np.testing.assert_allclose(lean[:, 2:], leant, atol=1e-4)  # of attitudes that were written as text
    config = dataclasses.replace(SMALL, env=dataclasses.replace(SMALL.env, actions="velocity"))
    numbers = ACTIONS[flown["action"]].T.astype(float)
    as_velocities = {name: column for name, column in flown.items() if name != "action"}
    as_velocities |= {f"action_{axis}": values for axis, values in enumerate(numbers)}
    np.testing.assert_array_equal(own_motions(config, as_velocities, decision_rows(config, flown)), motion)


@pytest.mark.whole
@pytest.mark.slow
def test_the_true_nearness_is_what_the_sensor_depth_would_show(sights, flight):
    flown, _ = flight
    shown = sights.shown(fresh_policy(SMALL), flown)
    position, quaternion = trajectory_poses(flown, decision_rows(SMALL, flown)[:, -1])
    true = jax.vmap(lambda p, q: sensor.nearness_image(SMALL, sights.scene, p, q))(position, quaternion)
    wanted = vae.decoder_target(SMALL.encoder, jnp.zeros((len(MOVES), HEIGHT, WIDTH)), true)[:, 0]
    np.testing.assert_allclose(shown.target, wanted, atol=1e-4)  # another program rounds otherwise
    assert shown.target.std() > 0.05 and shown.reconstruction.std() < shown.target.std()


@pytest.mark.slow
def test_a_fine_picture_is_the_drones_own_with_smaller_pixels(sights, flight):
    flown, _ = flight
    pose = trajectory_poses(flown, decision_rows(SMALL, flown)[-1, -1])
    fine = sights.rgb(*pose)
    assert fine.shape == (HEIGHT * FINE, WIDTH * FINE, 3)
    position, quaternion = map(jnp.asarray, pose)
    own = camera.render_rgb(SMALL.camera, sights.scene, position, sensor.mount_rotation(SMALL, quaternion))
    assert np.abs(downsample_picture(fine) - own).mean() < 0.01


def test_the_rows_of_a_decision_are_where_the_sensor_looks():
    steps = 2 * SMALL.drone.physics_steps + 5  # the third decision is not whole
    rows = decision_rows(SMALL, {"t": np.zeros(steps)})
    assert rows.tolist() == [[10, 12], [23, 25]]


def test_a_flight_shorter_than_a_decision_has_one():
    assert decision_rows(SMALL, {"t": np.zeros(3)}).tolist() == [[2, 2]]


@pytest.mark.slow
def test_a_sensor_without_an_image_has_rgb_only():
    blind = sights_of(dataclasses.replace(SMALL, env=dataclasses.replace(SMALL.env, sensor="blind")))
    assert not blind.has_image
    position, quaternion = np.array([0, 0, 4], np.float32), np.array([1, 0, 0, 0], np.float32)
    assert blind.rgb(position, quaternion).shape == (HEIGHT * FINE, WIDTH * FINE, 3)
