"""Light: one illuminance an episode, and what it does to events."""

# pyright: reportArgumentType=false

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import (
    SENSORS,
    CameraConfig,
    Config,
    DroneConfig,
    EnvConfig,
    EventsConfig,
    ExposureConfig,
    LightConfig,
)
from edqn_jax.config.loading import with_conditions
from edqn_jax.config.rules import validate
from edqn_jax.errors import ConfigError
from edqn_jax.interop.deployment.onnx_export import about_policy
from edqn_jax.learn import actor, policy
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.scene import stack_scenes
from edqn_jax.sim.sensors import contrast, event_field, light, photoreceptor
from edqn_jax.sim.task import env
from edqn_jax.sim.task.missions import own_missions
from edqn_jax.sim.task.observation import MOTION_SIZE, OWN_SIZE, Observation
from edqn_jax.sim.task.task import task_of
from tests.support.event_frames import PAPER, host, memory_of, random_frames, run
from tests.support.miniature import WORLD
from tests.support.registries import keep_as_they_are

LIT = Config(
    camera=CameraConfig(width=16, height=12),
    drone=DroneConfig(physics="rigid_body"),
    events=EventsConfig(bandwidth_hz=30.0, shot_rate_hz=5.0),
    light=LightConfig(0.1, 10_000.0),
)
DARK = dataclasses.replace(LIT, light=LightConfig())


@pytest.fixture(scope="module")
def world():
    pool = stack_scenes([load_scene(WORLD)])
    return env.EnvParams(load_airframe(Config().drone), pool, own_missions(pool))


def test_an_illuminance_is_log_uniform():
    lux = np.asarray(
        jax.vmap(lambda key: light.sample_illuminance(LIT.light, key))(jax.random.split(jax.random.key(0), 4000))
    )
    assert lux.min() >= 0.1 and lux.max() <= 10_000
    # 4000 draws: a share has a standard error of 0.8 %, and each decade has a fifth.
    shares = np.histogram(np.log10(lux), bins=[-1, 0, 1, 2, 3, 4])[0] / 4000
    np.testing.assert_allclose(shares, 0.2, atol=0.03)
    assert float(light.sample_illuminance(LightConfig(7.0, 7.0), jax.random.key(1))) == pytest.approx(7.0, rel=1e-6)


@pytest.mark.whole
def test_an_episode_keeps_its_light_and_the_next_one_has_another(world):
    state, _ = jax.jit(lambda key: env.reset(LIT, world, key))(jax.random.key(0))
    step = jax.jit(lambda s: env.step(LIT, world, s, 13)[0])
    after = step(state)
    assert state.memory.lux == after.memory.lux
    fresh = step(dataclasses.replace(after, ended=jnp.ones((), bool)))
    assert fresh.memory.lux != state.memory.lux and 0.1 <= fresh.memory.lux <= 10_000
    again, _ = jax.jit(lambda key: env.reset(LIT, world, key))(jax.random.key(0))
    assert again.memory.lux == state.memory.lux


def test_without_light_no_sensor_knows_of_it(world):
    state = jax.eval_shape(lambda key: env.before_reset(DARK, world, key), jax.random.key(0))
    assert state.memory.lux is None
    state = jax.eval_shape(lambda key: env.before_reset(Config(), world, key), jax.random.key(0))
    assert len(jax.tree.leaves(state.memory)) == 0


def lit(config: EventsConfig, lux: float | None, frames, key: int = 3) -> event_field.EventField:
    memory = memory_of(config, 0, *frames.shape[1:])
    if lux is not None:
        memory = dataclasses.replace(memory, lux=jnp.float32(lux))
    return host(run(config, memory, frames)[0])


@pytest.mark.parametrize("lux", [2.0, 10.0, 300.0])
def test_the_bandwidth_is_proportional_to_light(lux):
    frames = jnp.asarray(random_frames(1))
    config = dataclasses.replace(PAPER, bandwidth_hz=20.0)
    unlit = dataclasses.replace(PAPER, bandwidth_hz=20.0 * lux / 10.0)
    ours, theirs = lit(config, lux, frames), lit(unlit, None, frames)
    np.testing.assert_array_equal(ours.count * ours.polarity, theirs.count * theirs.polarity)


def test_less_light_leaves_fewer_events_of_what_moves():
    config = dataclasses.replace(PAPER, bandwidth_hz=30.0)
    frames = jnp.asarray(random_frames(1))
    counts = [lit(config, lux, frames).count.sum() for lux in (0.1, 1.0, 10.0, 100.0, 10_000.0)]
    assert counts == sorted(counts) and counts[0] == 0
    assert counts[-1] == lit(dataclasses.replace(config, bandwidth_hz=0.0), None, frames).count.sum() > 40


@pytest.mark.slow
@pytest.mark.parametrize("luma", [0.0, 1.0])
def test_shot_noise_rises_as_light_falls(luma):
    config, size = EventsConfig(shot_rate_hz=200.0, log_epsilon=1.0), 100
    frames = jnp.full((3, size, size), luma)
    current = (255.0 * luma + 20.0) / 275.0
    rates = []
    for lux in (1e-6, 1.0, 10.0, 100.0, 10_000.0):
        share = current * lux / 10.0
        wanted = 200.0 * (1 - 0.75 * share if share < 1 else 0.25 / share)
        mean = lit(config, lux, frames).count.sum() / (size * size * 0.04)
        # Poisson: the standard error of n events is their root.
        assert abs(mean - wanted) < 4 * np.sqrt(wanted / (size * size * 0.04)) + 1e-3
        rates.append(mean)
    assert rates[0] > rates[-1] * 3
    np.testing.assert_allclose(photoreceptor.shot_noise(jnp.array([0.0, 1.0, 2.0])), [1.0, 0.25, 0.125])


def test_shot_noise_follows_brightness_where_a_pixel_has_a_bandwidth():
    config, size = EventsConfig(shot_rate_hz=200.0, bandwidth_hz=30.0), 60
    frames = jnp.zeros((3, size, 2 * size)).at[:, :, size:].set(1.0)
    count = lit(config, None, frames).count.sum(0) / 0.04
    black = 200.0 * (1 - 0.75 * 20 / 275)
    assert abs(count[:, :size].mean() / black - 1) < 0.05  # 3600 pixels x 7.6 events: 0.6 %
    assert abs(count[:, size:].mean() / 50.0 - 1) < 0.05
    uniform = lit(dataclasses.replace(config, bandwidth_hz=0.0), None, frames).count.sum(0) / 0.04
    assert abs(uniform[:, :size].mean() / uniform[:, size:].mean() - 1) < 0.05


@pytest.mark.parametrize("sensor", ["events", "frame-pair"])
def test_the_networks_are_told_the_light_of_an_episode_before_its_contrast(world, sensor):
    told = dataclasses.replace(
        LIT,
        light=LightConfig(0.1, 10_000.0, told=True),
        exposure=ExposureConfig(real=True),
        env=EnvConfig(sensor=sensor),
        events=dataclasses.replace(LIT.events, least_contrast=0.02, most_contrast=0.3),
    )
    validate(told)
    state, seen = jax.jit(lambda key: env.reset(told, world, key))(jax.random.key(0))
    value, more = (np.log10(float(state.memory.lux)) - 1.5) / 2.5, 1 + (sensor == "events")
    for values, size in ((seen.own, OWN_SIZE), (seen.motion, MOTION_SIZE)):
        assert values.shape == (size + more,)
        np.testing.assert_allclose(values[size], value, atol=1e-5)
    assert more == 1 or float(seen.own[-1]) == pytest.approx(float(contrast.value_of(state.memory.contrast)), abs=1e-6)
    blank = actor.blank_observation(told)
    assert (blank.own.shape, blank.motion.shape) == (seen.own.shape, seen.motion.shape)
    task = task_of(told)
    assert task.mirror is not None and task.mirror[MOTION_SIZE:] == (1.0,) * more


def test_light_is_told_only_where_there_is_some_and_of_sensors_that_depend_on_it():
    blind = dataclasses.replace(LIT, light=LightConfig(1.0, 1.0, told=True), env=EnvConfig(sensor="blind"))
    assert task_of(blind).own_size == OWN_SIZE
    with pytest.raises(ConfigError, match="light.told must be false without light.least_lux and light.most_lux"):
        validate(dataclasses.replace(LIT, light=LightConfig(told=True)))
    with pytest.raises(ConfigError, match="exposure.real must be true with light.told and env.sensor frames"):
        validate(dataclasses.replace(blind, env=EnvConfig(sensor="frames")))
    with pytest.raises(ConfigError, match="'light.told' is a policy's own"):
        with_conditions(LIT, {"light": {"told": True}}, "conditions")
    with pytest.raises(ConfigError, match="knows the light .* cannot be exported"):
        about_policy(dataclasses.replace(blind, env=EnvConfig()))


def test_an_own_sensor_that_exposes_or_makes_events_is_told_its_light(world, monkeypatch):
    keep_as_they_are(monkeypatch)
    frames = SENSORS.get("frames")
    SENSORS.register("mine", dataclasses.replace(frames))
    SENSORS.register("counts", dataclasses.replace(SENSORS.get("event-image")))
    told = dataclasses.replace(LIT, light=LightConfig(0.1, 10_000.0, told=True), env=EnvConfig(sensor="mine"))
    with pytest.raises(ConfigError, match="exposure.real must be true with light.told and env.sensor mine"):
        validate(told)
    for sensor in ("mine", "counts"):
        real = dataclasses.replace(told, exposure=ExposureConfig(real=True), env=EnvConfig(sensor=sensor))
        validate(real)
        state, seen = jax.jit(lambda key, config=real: env.reset(config, world, key))(jax.random.key(0))
        assert float(seen.own[OWN_SIZE]) == pytest.approx(float(light.value_of(state.memory.lux)), abs=1e-6)
    blank = {"show": lambda *_: (jnp.zeros((1, 12, 16)), None), "at_rest": lambda config, key: None}
    SENSORS.register("forgets", dataclasses.replace(frames, **blank))
    real = dataclasses.replace(real, env=EnvConfig(sensor="forgets"))
    with pytest.raises(ConfigError, match="memory of the sensor 'forgets' must have the episode's `lux`"):
        jax.eval_shape(lambda key: env.reset(real, world, key), jax.random.key(0))


def test_a_policy_is_flown_in_other_light_than_it_was_trained_in():
    darker = with_conditions(Config(), {"light": {"least_lux": 0.5, "most_lux": 0.5}}, "conditions")
    assert darker.light == LightConfig(0.5, 0.5)
    with pytest.raises(ConfigError, match=r"light.least_lux must be at most light.most_lux \(0.5\)"):
        with_conditions(darker, {"light": {"least_lux": 2.0}}, "conditions")


def test_a_policy_is_flown_with_another_sensor_than_it_was_trained_with():
    noisy = with_conditions(Config(), {"events": {"profile": "dvs", "shot_rate_hz": 1.0}}, "conditions")
    assert (noisy.events.bandwidth_hz, noisy.events.threshold, noisy.events.shot_rate_hz) == (30.0, 0.2, 1.0)
    with pytest.raises(ConfigError, match="'events.law' is a policy's own; .* of events the pixels' thresholds"):
        with_conditions(Config(), {"events": {"law": "esim"}}, "conditions")


@pytest.mark.whole
def test_a_policy_acts_on_events_with_and_without_noise():
    """Rows of ON and of OFF events are the same channels to an encoder that was trained without noise."""
    noisy = dataclasses.replace(DARK, events=dataclasses.replace(DARK.events, shot_rate_hz=1e-6))
    quiet = dataclasses.replace(DARK, events=dataclasses.replace(DARK.events, shot_rate_hz=0.0))
    flies = policy.Policy(quiet, policy.fresh_policy(quiet))
    frames = jnp.exp(jnp.asarray(np.random.default_rng(0).normal(-1.0, 0.3, (2, 12, 16)))).clip(0.0, 1.0)
    seen = []
    for config in (quiet, noisy):
        field, _ = run(config.events, memory_of(config.events, 0, 12, 16), frames, config.events.frame_times_s)
        seen.append(Observation(field, jnp.ones(OWN_SIZE), jnp.ones(MOTION_SIZE)))
    assert seen[0].sensed.count.shape[0] * 2 == seen[1].sensed.count.shape[0] == 2
    codes = [flies.code(each) for each in seen]
    np.testing.assert_array_equal(codes[0], codes[1])
