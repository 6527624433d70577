"""Photoreceptors of finite bandwidth: against the differential equation, and what they do to events."""

# pyright: reportArgumentType=false

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edqn_jax.config import CameraConfig, Config, DroneConfig, EventsConfig, LightConfig
from edqn_jax.config.rules import validate
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.scene import stack_scenes
from edqn_jax.sim.sensors import event_laws, event_memory, events, photoreceptor, sensor
from edqn_jax.sim.task import env
from edqn_jax.sim.task.missions import own_missions
from tests.oracles import photoreceptor_plain
from tests.support.event_frames import (
    AIRSIM,
    ESIM,
    PAPER,
    TIMES,
    host,
    levels,
    long_flight,
    memory_of,
    random_frames,
    run,
)
from tests.support.miniature import WORLD

SLOW = {"bandwidth_hz": 30.0}
few = settings(max_examples=12, deadline=None, derandomize=True)


@few
@given(seed=st.integers(0, 2**31 - 1), cutoff=st.floats(0.1, 1000.0))
def test_a_photoreceptor_follows_its_differential_equation(seed, cutoff):
    luma, lag = random_frames(seed), np.random.default_rng(seed).normal(0, 0.3, (4, 5)).astype(np.float32)
    level, times = levels(PAPER, luma), np.array([0.0, 0.01, 0.05])
    current = photoreceptor.between_frames(photoreceptor.photocurrent(jnp.asarray(luma)))
    shown, last = photoreceptor.filter_log_brightness(cutoff, jnp.asarray(level), times, current, jnp.asarray(lag))
    plain = photoreceptor_plain.follow(cutoff, level, times, luma, lag)
    # Heun's rule in steps of 1e-5 s is good to 1e-5; levels of up to 7 in float32.
    np.testing.assert_allclose(shown, plain, atol=3e-5)
    np.testing.assert_allclose(last, plain[-1] - level[-1], atol=3e-5)


def test_a_frame_in_between_that_is_on_the_line_changes_nothing():
    level = jnp.stack([jnp.zeros((2, 2)), jnp.full((2, 2), 0.5), jnp.full((2, 2), 2.0)])
    current, lag = jnp.full((2, 2, 2), 0.4), jnp.full((2, 2), -0.1)
    fine, _ = photoreceptor.filter_log_brightness(20.0, level, np.array([0.0, 0.01, 0.04]), current, lag)
    coarse, _ = photoreceptor.filter_log_brightness(20.0, level[::2], np.array([0.0, 0.04]), current[:1], lag)
    np.testing.assert_allclose(fine[-1], coarse[-1], rtol=1e-6)


def test_of_a_jump_in_no_time_nothing_is_followed():
    level, lag = jnp.array([0.0, 1.0])[:, None, None], jnp.full((1, 1), -0.2)
    _, last = photoreceptor.filter_log_brightness(30.0, level, np.array([0.0, 0.0]), jnp.ones((1, 1, 1)), lag)
    assert abs(float(last[0, 0]) + 1.2) < 1e-6


def test_a_step_of_a_white_pixel_is_followed_to_63_percent_in_the_time_constant():
    """After the step x stays; the pixel had settled before it."""
    time_constant = 1 / (2 * np.pi * 30.0)
    level = jnp.array([0.0, 1.0, 1.0])[:, None, None]
    times = np.array([0.0, 1e-7, time_constant])
    shown, _ = photoreceptor.filter_log_brightness(30.0, level, times, jnp.ones((2, 1, 1)), jnp.zeros((1, 1)))
    assert abs(float(shown[-1, 0, 0]) - (1 - np.exp(-1))) < 1e-4


@pytest.mark.parametrize("law", [PAPER, AIRSIM, ESIM], ids=["paper", "airsim", "esim"])
def test_a_very_fast_photoreceptor_shows_the_events_of_an_ideal_one(law):
    config = dataclasses.replace(law, airsim_tolerance=0.1)
    fast = dataclasses.replace(config, bandwidth_hz=1e9)
    frames = jnp.asarray(random_frames(4))
    ideal, fields = (host(run(each, memory_of(each, 2), frames)[0]) for each in (config, fast))
    assert ideal.count.sum() > 20
    np.testing.assert_array_equal(ideal.count, fields.count)
    np.testing.assert_array_equal(ideal.polarity, fields.polarity)


@pytest.mark.parametrize("law", [PAPER, AIRSIM, ESIM], ids=["paper", "airsim", "esim"])
def test_the_same_contrast_makes_fewer_events_in_a_dark_pixel_than_in_a_bright_one(law):
    config = dataclasses.replace(law, airsim_tolerance=0.1, refractory_ns=1000.0, log_epsilon=1e-9, **SLOW)
    before = jnp.array([0.02, 0.08, 0.4])[None, :]
    frames = jnp.stack([before, before * 2.0])
    memory = event_memory.reset_memory(config, 1, 3, jax.random.key(0))
    if memory.residual is not None:
        memory = dataclasses.replace(memory, residual=jnp.zeros((1, 3)))
    field, _ = event_laws.generate_events(config, memory, frames, (0.0, 0.04), jax.random.key(0))
    dark, middle, bright = np.asarray(field.count[0, 0])
    assert 0 <= dark < middle < bright <= np.log(2) / 0.09


def test_a_window_without_a_known_gap_before_it_begins_settled():
    config = dataclasses.replace(PAPER, **SLOW)
    frames, memory = jnp.asarray(random_frames(5)), memory_of(config, 0)
    first, after = run(config, memory, frames)
    again, _ = run(config, after, frames)
    assert np.abs(after.lag).max() > 0.1
    for name in ("count", "t_first", "t_step"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))


GAP = 0.22
"""Seconds between the windows of two decisions."""


@pytest.mark.parametrize("lux", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("law", [PAPER, AIRSIM, ESIM], ids=["paper", "airsim", "esim"])
def test_the_lag_of_an_episode_is_that_of_one_filter_over_all_of_it(law, lux):
    """Decision by decision, with gaps in which nothing is rendered, against a filter that never stops."""
    config = dataclasses.replace(law, airsim_tolerance=0.001, tolerance=0.001, threshold=0.001, **SLOW)
    config = dataclasses.replace(config, contrast_on=0.001, contrast_off=0.001, refractory_ns=1.0)
    frames = long_flight(6, 18)
    times = np.concatenate([0.26 * k + np.array(TIMES) for k in range(6)])
    memory = dataclasses.replace(memory_of(config, 3), lux=jnp.float32(lux))
    level = (
        events.airsim_log_brightness(frames) if law is AIRSIM else events.log_brightness(config, frames)
    ).__array__()
    shown = photoreceptor_plain.follow(30.0 * lux / 10.0, level, times, frames, np.zeros(level.shape[1:]), parts=400)
    changes = []
    for k in range(6):
        field, memory = run(config, memory, jnp.asarray(frames[3 * k : 3 * k + 3]), gap_s=GAP)
        np.testing.assert_allclose(memory.lag, shown[3 * k + 2] - level[3 * k + 2], atol=2e-4)
        changes.append(0.001 * np.asarray(field.count * field.polarity).sum(0))
    wanted = shown[2::3] - shown[::3]
    # Of each frame pair less than a threshold is left over, by AirSim's law less than two.
    assert np.abs(np.array(changes) - wanted).max() < 0.005
    assert lux > 1 or np.abs(wanted[1:]).max() > 2 * np.abs(wanted[0]).max()  # what came before is still seen


@pytest.mark.parametrize(("lux", "most"), [(0.1, 0.04), (1.0, 0.31)])
def test_a_steady_change_is_seen_in_full_however_dark(lux, most):
    config = dataclasses.replace(PAPER, **SLOW, threshold=1e-5, tolerance=1e-5, refractory_ns=1.0)
    memory = dataclasses.replace(memory_of(config, 0), lux=jnp.float32(lux))
    slope = 0.025  # of log brightness, 1/s: 0.39 in the 60 decisions that follow
    for gap_s, least, largest in ((GAP, 0.95, 1.05), (None, 0.0, most)):
        carried = memory
        for k in range(60):
            level = -1.0 + slope * (0.26 * k + np.array(TIMES))
            frames = jnp.broadcast_to(jnp.exp(jnp.asarray(level, jnp.float32))[:, None, None], (3, 4, 5))
            field, carried = run(config, carried, frames, gap_s=gap_s)
        share = 1e-5 * float(field.count[:, 0, 0].sum()) / (slope * 0.04)
        assert least <= share <= largest


def test_the_lag_of_a_stream_is_carried_from_window_to_window():
    config, frames = dataclasses.replace(ESIM, **SLOW), long_flight(2, 41)
    times = tuple(0.02 * k for k in range(41))
    memory = memory_of(config, 4)
    whole, end = run(config, memory, jnp.asarray(frames), times, True)
    streamed = []
    for k in range(0, 40, 4):
        field, memory = run(config, memory, jnp.asarray(frames[k : k + 5]), times[:5], True)
        streamed.append(np.asarray(field.count * field.polarity))
    np.testing.assert_array_equal(np.concatenate(streamed), whole.count * whole.polarity)
    np.testing.assert_allclose(memory.lag, end.lag, atol=1e-5)
    assert np.abs(np.asarray(end.lag)).max() > 0.01
    # With a gap before it a window begins settled: another one than in the stream.
    gap, _ = run(config, memory, jnp.asarray(frames[36:]), times[:5], False)
    assert np.any(np.asarray(gap.count * gap.polarity) != streamed[-1])
    settled, _ = run(config, memory.replace(lag=jnp.zeros((4, 5))), jnp.asarray(frames[36:]), times[:5], False)
    np.testing.assert_array_equal(gap.count, settled.count)


def test_what_esim_shows_is_the_photoreceptor_within_one_threshold():
    config, frames = dataclasses.replace(ESIM, **SLOW), long_flight(3, 50)
    times = np.array([0.02 * k for k in range(50)])
    memory = memory_of(config, 11)
    field, _ = run(config, memory, jnp.asarray(frames), tuple(times), True)
    level = levels(config, frames).astype(np.float64)
    shown = photoreceptor_plain.follow(30.0, level, times, frames, np.zeros(level.shape[1:]), parts=400)
    count, polarity = np.asarray(field.count), np.asarray(field.polarity)
    jump = np.cumsum(count * np.where(polarity > 0, config.contrast_on, -config.contrast_off), 0)
    error = np.abs(shown[1:] - (shown[0] - np.asarray(memory.residual) + jump))
    # 1e-3: Heun's rule in steps of 5e-5 s.
    assert error.max() <= max(config.contrast_on, config.contrast_off) + 1e-3
    assert np.abs(shown - level).max() > 0.2  # which lags far behind the light


def test_infinite_bandwidth_traces_nothing():
    trace = jax.make_jaxpr(
        lambda k, f: event_laws.generate_events(PAPER, event_memory.EventMemory(None, None, None, None), f, TIMES, k)
    )
    plain = str(trace(jax.random.key(0), jnp.ones((3, 2, 2))))
    assert "exp" not in plain and EventsConfig().bandwidth_hz == 0


@pytest.fixture(scope="module")
def flown():
    """The configuration and world of a noiseless slow sensor, and the state after three decisions, each."""
    options = EventsConfig(**SLOW)
    drone = DroneConfig(physics="rigid_body")
    config = Config(camera=CameraConfig(width=16, height=12), drone=drone, events=options, light=LightConfig(1.0, 1.0))
    pool = stack_scenes([load_scene(WORLD)])
    world = env.EnvParams(load_airframe(drone), pool, own_missions(pool))
    step = jax.jit(lambda s, move: env.step(config, world, s, move))
    states, flights = [jax.jit(lambda key: env.reset(config, world, key))(jax.random.key(0))[0]], []
    for move in (26, 22, 4):
        state, seen = step(states[-1], move)
        states.append(state)
        flights.append(seen.flight)
    return config, pool, step, states, flights


def test_an_environment_carries_the_lag_from_decision_to_decision(flown):
    config, pool, _, states, flights = flown
    first, scene = states[0].drone, jax.tree.map(lambda x: x[0], pool)
    # The windows begin after 11 of the 13 physics steps, and end with them.
    rows = [(flight.position[i], flight.quaternion[i]) for flight in flights for i in (10, 12)]
    places, attitudes = (
        jnp.stack([start, start, *path])
        for start, path in zip((first.position, first.quaternion), zip(*rows, strict=True), strict=True)
    )
    see = jax.jit(jax.vmap(lambda p, q: sensor.render_view(config, scene, p, q)))
    frames = np.asarray(see(places, attitudes))
    times = np.concatenate([0.26 * k + np.array([-0.04, 0.0]) for k in range(4)])
    level = levels(config.events, frames)
    plain = photoreceptor_plain.follow(3.0, level, times, frames, np.zeros(level.shape[1:]), parts=1000)
    for k, state in enumerate(states):
        np.testing.assert_allclose(state.memory.lag, plain[2 * k + 1] - level[2 * k + 1], atol=2e-3)
    assert np.abs(states[-1].memory.lag).max() > 0.1


def test_an_episode_begins_with_settled_pixels(flown):
    _, _, step, states, _ = flown
    fresh, seen = step(dataclasses.replace(states[-1], ended=jnp.ones((), bool)), 0)
    assert bool(seen.is_reset) and int(seen.observation.sensed.count.sum()) == 0
    np.testing.assert_allclose(fresh.memory.lag, 0.0, atol=1e-6)
    assert float(fresh.memory.frame.min()) >= 0


def test_pixels_without_bandwidth_limits_carry_nothing(flown):
    config = flown[0]
    ideal = dataclasses.replace(config, events=EventsConfig(), light=LightConfig())
    assert jax.tree.leaves(sensor.at_rest(ideal, jax.random.key(0))) == []
    assert len(jax.tree.leaves(sensor.at_rest(config, jax.random.key(0)))) == 3  # light, lag and last frame


@pytest.mark.whole
@pytest.mark.slow
def test_decisions_of_a_stream_are_one_recording_of_the_flight():
    """Windows go on where they ended: no change is lost between two decisions, and none counted twice."""
    times = tuple(round(-0.26 + 0.02 * step, 2) for step in range(14))
    options = EventsConfig(law="esim", stream=True, frame_times_s=times, **SLOW)
    camera, drone = CameraConfig(width=16, height=12), DroneConfig(physics="rigid_body")
    config = Config(camera=camera, drone=drone, events=options)
    validate(config)
    pool = stack_scenes([load_scene(WORLD)])
    world = env.EnvParams(load_airframe(drone), pool, own_missions(pool))
    begun, _ = jax.jit(lambda key: env.reset(config, world, key))(jax.random.key(0))
    step, state, steps = jax.jit(lambda s, move: env.step(config, world, s, move)), begun, []
    for move in (26, 22, 4):
        state, seen = step(state, move)
        steps.append(seen)
    fields = [host(each.observation.sensed) for each in steps]
    assert all(field.count.shape == (13, 12, 16) for field in fields)

    body, scene = begun.drone, jax.tree.map(lambda x: x[0], pool)
    position = jnp.concatenate([body.position[None], *(each.flight.position for each in steps)])
    quaternion = jnp.concatenate([body.quaternion[None], *(each.flight.quaternion for each in steps)])
    frames = jax.jit(jax.vmap(lambda p, q: sensor.render_view(config, scene, p, q)))(position, quaternion)
    whole, end = run(options, begun.memory, frames, tuple(0.02 * k for k in range(40)), True)
    streamed = np.concatenate([field.count * field.polarity for field in fields])
    recorded = np.asarray(whole.count * whole.polarity)
    # Two programs draw the frames: a level that is met almost exactly may be counted a frame later.
    assert np.mean(streamed != recorded) < 0.002 and np.abs(recorded).sum() > 500
    assert np.abs(streamed.sum(0) - recorded.sum(0)).max() <= 1
    np.testing.assert_allclose(state.memory.lag, end.lag, atol=1e-3)
