"""A frame camera's clock: which frame a decision sees, how old it is, and from where it was taken."""

# pyright: reportArgumentType=false

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edqn_jax.config import CameraConfig, Config, DroneConfig, EnvConfig, ExposureConfig, LightConfig
from edqn_jax.config.rules import validate
from edqn_jax.errors import ConfigError
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.scene import stack_scenes
from edqn_jax.sim.sensors import exposure, frame_clock, sensor
from edqn_jax.sim.task import env
from edqn_jax.sim.task.missions import own_missions
from edqn_jax.sim.task.observation import MOTION_SIZE, lean_of, motion_size, with_lean
from tests.oracles import frame_clock_plain
from tests.support.miniature import WORLD

few = settings(max_examples=15, deadline=None, derandomize=True)
PAIR = (-0.04, 0.0)
DT = 0.02

poses_of_frames = jax.jit(exposure.poses_of_frames, static_argnums=(0, 4))


def config_of(rate: float, latency: float, steps: int = 13, name: str = "frames", **exposed) -> Config:
    return Config(
        camera=CameraConfig(width=16, height=12),
        drone=DroneConfig(physics="rigid_body", physics_steps=steps),
        env=EnvConfig(sensor=name),
        exposure=ExposureConfig(rate_hz=rate, latency_s=latency, **exposed),
    )


def flight_of(path: np.ndarray, first: int, steps: int, *, times: bool = False) -> Flight:
    """Poses [steps + 1] of a path [N, 3] from row `first` on."""
    rows = jnp.asarray(path[first : first + steps + 1], jnp.float32)
    upright = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (steps + 1, 1))
    return Flight(rows, upright, rows, (first + jnp.arange(steps + 1)) * DT if times else None)


@pytest.mark.whole
@few
@given(
    seed=st.integers(0, 2**31 - 1),
    rate=st.sampled_from([5.0, 30.0, 60.0, 120.0, 200.0]),
    latency=st.sampled_from([0.0, 0.01, 0.02, 0.3]),
    steps=st.sampled_from([2, 13]),
)
def test_each_decision_sees_the_newest_frame_that_is_there_from_where_it_was_taken(seed, rate, latency, steps):
    config = config_of(rate, latency, steps, "frame-pair")
    path = np.cumsum(np.random.default_rng(seed).normal(size=(1 + 12 * steps, 3)), 0)
    clock = frame_clock.at_rest(config, PAIR, jax.random.key(seed))
    # The first observation, at time 0, has the drone stand at its start for a decision.
    poses, phase = flight_of(np.tile(path[:1], (steps + 1, 1)), 0, steps), -latency - float(clock.ready)
    apart = max(round(0.04 * rate), 1) / rate
    for decision in range(13):
        now = decision * steps * DT
        if decision:
            poses = flight_of(path, (decision - 1) * steps, steps)
        taken, clock = poses_of_frames(config, clock, poses, jnp.zeros(()), PAIR)
        # A hair later, since a frame may come at the very time of a decision.
        end = frame_clock_plain.newest_end(now + 1e-5, rate, phase, latency)
        wanted = [frame_clock_plain.place_at(time, path, DT) for time in (end - apart, end)]
        found = np.asarray(taken.position[:, 0])
        if abs(end + 1 / rate + latency - now) > 1e-4 and abs(end + latency - now) > 1e-4:
            np.testing.assert_allclose(found, wanted, atol=2e-3)
            assert latency - 1e-4 <= now - end <= latency + 1 / rate + 1e-4


def test_a_phase_is_drawn_for_each_episode_and_stays_within_a_period():
    config = config_of(30.0, 0.01)
    drawn = [float(frame_clock.at_rest(config, PAIR, jax.random.key(seed)).ready) for seed in range(200)]
    # Uniform: a mean of 200 has a standard error of 2 % of the period.
    assert abs(np.mean(drawn) * 30 - 0.5) < 0.1 and min(drawn) >= 0 and max(drawn) < 1 / 30
    clock, still = frame_clock.at_rest(config, PAIR, jax.random.key(0)), flight_of(np.zeros((14, 3)), 0, 13)
    read = jax.jit(lambda clock: frame_clock.read_clock(config, clock, still, PAIR))
    for _ in range(200):
        before = float(clock.ready)
        _, age, clock = read(clock)
        assert 0.01 <= float(age[-1]) < 0.01 + 1 / 30 and abs(float(age[-1]) - before - 0.01) < 1e-6


def test_latency_without_a_rate_is_an_age_that_stays():
    config = config_of(0.0, 0.03, name="frame-pair")
    clock = frame_clock.at_rest(config, PAIR, jax.random.key(0))
    assert clock.ready is None and clock.past is None
    path = np.linspace(0.0, 2.6, 14)[:, None] * np.array([1.0, 0.0, 0.0])
    taken, _ = exposure.poses_of_frames(config, clock, flight_of(path, 0, 13), jnp.zeros(()), PAIR)
    np.testing.assert_allclose(taken.position[:, 0, 0], [2.6 - 0.7, 2.6 - 0.3], atol=1e-5)


@pytest.mark.parametrize(
    ("rate", "times", "offsets"),
    [
        (30.0, PAIR, (1 / 30, 0.0)),
        (60.0, PAIR, (2 / 60, 0.0)),
        (120.0, PAIR, (5 / 120, 0.0)),
        (10.0, (-0.04, -0.02, 0.0), (0.2, 0.1, 0.0)),
        (0.0, PAIR, (0.04, 0.0)),
        (30.0, (0.0,), (0.0,)),
    ],
)
def test_frames_of_a_decision_are_whole_periods_apart(rate, times, offsets):
    found = frame_clock.frame_offsets_s(ExposureConfig(rate_hz=rate, latency_s=0.01), times)
    np.testing.assert_allclose(found, offsets, atol=1e-9)


def test_poses_before_the_decision_are_kept_where_they_are_needed():
    assert frame_clock.steps_before(config_of(30.0, 0.01), (0.0,)) == 0
    # 1/30 + 1/30 + 0.015 s are 4.1 steps, of which a decision at 25 Hz has 2.
    assert frame_clock.steps_before(config_of(30.0, 0.015, steps=2), PAIR) == 3
    lit = dataclasses.replace(config_of(30.0, 0.015, steps=2, real=True), light=LightConfig(100.0, 100.0))
    assert frame_clock.steps_before(lit, PAIR) == 4


def test_what_moves_is_seen_as_it_stood_when_the_frame_was_taken():
    config = config_of(0.0, 0.07, steps=2)
    clock = frame_clock.at_rest(config, (0.0,), jax.random.key(0))
    for decision in range(3):
        poses = flight_of(np.zeros((99, 3)), 2 * decision, 2, times=True)
        taken, clock = exposure.poses_of_frames(config, clock, poses, jnp.zeros(()), (0.0,))
        assert taken.time is not None
        np.testing.assert_allclose(taken.time[:, 0], [0.04 * (decision + 1) - 0.07], atol=1e-6)


def test_an_exposure_of_the_clock_ends_with_the_frame_and_began_before():
    config = config_of(0.0, 0.05, real=True, sub_frames=4)
    clock = frame_clock.at_rest(config, (0.0,), jax.random.key(0))
    path = np.arange(14)[:, None] * DT * np.array([1.0, 0.0, 0.0])  # a metre a second
    taken, _ = exposure.poses_of_frames(config, clock, flight_of(path, 0, 13), jnp.float32(0.02), (0.0,))
    np.testing.assert_allclose(
        taken.position[0, :, 0], 0.26 - 0.05 - np.array([0.0025, 0.0075, 0.0125, 0.0175]), atol=1e-6
    )


def test_no_exposure_is_longer_than_the_period():
    options = ExposureConfig(real=True, rate_hz=200.0)
    time, gain = exposure.exposure_settings(options, jnp.float32(1.0), jnp.float32(0.4))
    assert float(time) == pytest.approx(0.005) and float(gain) == 4.0


@pytest.mark.parametrize("name", ["frames", "frame-pair"])
def test_a_camera_without_a_clock_is_as_it_was(name):
    config = config_of(0.0, 0.0, name=name)
    assert sensor.at_rest(config, jax.random.key(0)) is None
    assert sensor.frame_steps(config) == {"frames": (13,), "frame-pair": (11, 13)}[name]
    clocked = config_of(60.0, 0.01, name=name)
    assert sensor.frames_per_decision(clocked) == sensor.frames_per_decision(config)
    assert (
        sensor.frames_per_decision(dataclasses.replace(clocked, exposure=REAL)) == len(sensor.frame_steps(config)) * 5
    )


REAL = ExposureConfig(real=True, rate_hz=60.0, latency_s=0.015)


def test_an_environment_shows_the_frame_of_the_clock():
    """Decisions at 25 Hz and a camera at 30 Hz: what is shown was seen before the decision began."""
    config = config_of(30.0, 0.02, steps=2)
    validate(config)
    pool = stack_scenes([load_scene(WORLD)])
    world = env.EnvParams(load_airframe(config.drone), pool, own_missions(pool))
    step = jax.jit(lambda s, move: env.step(config, world, s, move))
    state, _ = jax.jit(lambda key: env.reset(config, world, key))(jax.random.key(1))
    path, scene = [np.asarray(state.drone.position)], jax.tree.map(lambda x: x[0], pool)
    phase = -0.02 - (float(state.memory.clock.ready) - 0.04) % (1 / 30)
    for _ in range(6):
        state, seen = step(state, 26)
        path.extend(np.asarray(seen.flight.position))
    end = frame_clock_plain.newest_end(0.24 + 1e-5, 30.0, phase, 0.02)
    assert end < 0.24 - 0.02
    shown = np.asarray(seen.observation.sensed[0])
    place = frame_clock_plain.place_at(end, np.array(path), DT)
    see = jax.jit(lambda p: sensor.brightness(config, sensor.render_view(config, scene, p, state.drone.quaternion)))
    wanted, now = (np.asarray(see(jnp.asarray(where, jnp.float32))) for where in (place, path[-1]))
    error = np.median(np.abs(shown - wanted))
    assert error < 5e-4 and np.median(np.abs(now - wanted)) > 4 * error  # the heading has hardly changed
    fresh, again = step(dataclasses.replace(state, ended=jnp.ones((), bool)), 0)
    assert bool(again.is_reset) and float(fresh.memory.clock.ready) != float(state.memory.clock.ready)
    np.testing.assert_allclose(fresh.memory.clock.past.position, fresh.drone.position[None], atol=1e-6)


def test_a_camera_on_the_body_knows_how_it_leant_at_each_frame():
    config = config_of(0.0, 0.05, name="frame-pair")
    config = dataclasses.replace(config, camera=dataclasses.replace(config.camera, mount="body"))
    assert sensor.count_attitudes(config) == 2 and motion_size(config) == MOTION_SIZE + 4
    clock, flight = frame_clock.at_rest(config, PAIR, jax.random.key(0)), flight_of(np.zeros((14, 3)), 0, 13)
    roll = np.linspace(0.0, 1.3, 14)  # 0.1 rad a step
    attitudes = np.stack([np.cos(roll / 2), np.sin(roll / 2), np.zeros(14), np.zeros(14)], axis=1)
    flight = dataclasses.replace(flight, quaternion=jnp.asarray(attitudes, jnp.float32))
    _, clock = exposure.poses_of_frames(config, clock, flight, jnp.zeros(()), PAIR)
    seen = sensor.attitudes_seen(flight, exposure.FrameMemory(None, None, clock))
    motion = with_lean(config, seen, jnp.zeros(MOTION_SIZE))
    np.testing.assert_allclose(lean_of(config, motion), [[1.3 - 0.45, 0.0], [1.3 - 0.25, 0.0]], atol=1e-3)


def test_clocks_that_cannot_be_are_said():
    with pytest.raises(ConfigError, match="exposure.rate_hz must be 0, or from 1 to 1000, not 0.5"):
        validate(config_of(0.5, 0.0))
    with pytest.raises(ConfigError, match=r"exposure.shortest_s must be at most 0.001, the period of exposure.rate_hz"):
        validate(config_of(1000.0, 0.0, shortest_s=0.002))
    lit = dataclasses.replace(config_of(30.0, 0.0, real=True, longest_s=1.5), light=LightConfig(1.0, 1.0))
    with pytest.raises(ConfigError, match=r"exposure.longest_s must be at most 1 with exposure.rate_hz"):
        validate(lit)
