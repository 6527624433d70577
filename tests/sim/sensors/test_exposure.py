"""A camera that takes frames: exposure, blur, noise and 8 bits, against a plain one and by their properties."""

# pyright: reportArgumentType=false

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import edqn_jax
from edqn_jax.config import CameraConfig, Config, DroneConfig, EnvConfig, ExposureConfig, LightConfig, WorldConfig
from edqn_jax.config.rules import validate
from edqn_jax.errors import ConfigError
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene import mjcf
from edqn_jax.sim.scene.scene import scene_at, stack_scenes
from edqn_jax.sim.sensors import built_in, exposure, sensor
from edqn_jax.sim.sensors.exposure import FrameMemory
from edqn_jax.sim.task import env
from edqn_jax.sim.task.missions import own_missions
from tests.oracles import exposure_plain
from tests.support.miniature import WORLD

few = settings(max_examples=20, deadline=None, derandomize=True)
REAL = ExposureConfig(real=True)
CAMERA = CameraConfig(width=16, height=12)


def config_of(name: str, exposed: ExposureConfig = REAL, **groups) -> Config:
    drone, task = DroneConfig(physics="rigid_body"), EnvConfig(sensor=name)
    return Config(camera=CAMERA, drone=drone, env=task, light=LightConfig(0.1, 10_000.0), exposure=exposed, **groups)


@few
@given(lux=st.floats(0.1, 10_000.0), mean=st.floats(0.01, 1.0))
def test_time_and_gain_are_the_least_that_reach_the_target(lux, mean):
    time, gain = exposure.exposure_settings(REAL, jnp.float32(lux), jnp.float32(mean))
    plain = exposure_plain.settings(lux, mean, 0.4, 1e-4, 0.02, 4.0, 6000.0, 10_000.0)
    # A step of the search is 5e-5 of the time.
    np.testing.assert_allclose([time, gain], plain, rtol=2e-4)


@pytest.mark.whole
@few
@given(seed=st.integers(0, 2**31 - 1), steps=st.integers(1, 3), share=st.floats(0.01, 1.0))
def test_sub_frames_are_taken_where_the_drone_was(seed, steps, share):
    rng, dt = np.random.default_rng(seed), 0.02
    position, quaternion = rng.normal(size=(steps + 1, 3)), rng.normal(size=(steps + 1, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    time = share * steps * dt
    times = np.arange(steps + 1) * dt + 1.0
    poses = Flight(*(jnp.asarray(x, jnp.float32) for x in (position, quaternion, position, times)))
    config = dataclasses.replace(config_of("frames"), exposure=dataclasses.replace(REAL, longest_s=steps * dt))
    taken, clock = exposure.poses_of_frames(config, None, poses, jnp.float32(time), (0.0,))
    found = jax.tree.map(lambda x: x[0], taken)
    assert clock is None
    for k in range(5):
        before = time * (k + 0.5) / 5
        where, attitude = exposure_plain.pose(position, quaternion, dt, before)
        np.testing.assert_allclose(found.position[k], where, atol=2e-5)
        assert abs(np.asarray(found.quaternion[k]) @ attitude) > 1 - 1e-5  # q and -q are the same
        assert found.time is not None and abs(float(found.time[k]) - (times[-1] - before)) < 1e-6


@few
@given(
    seed=st.integers(0, 2**31 - 1),
    lux=st.floats(0.1, 10_000.0),
    gain=st.floats(1.0, 4.0),
    bits=st.sampled_from([8, 10, 12]),
)
def test_levels_are_those_of_the_plain_camera(seed, lux, gain, bits):
    luma = np.random.default_rng(seed).random((4, 5)).astype(np.float32)
    key, time = jax.random.key(seed), 0.4 * 10_000 / (6000 * lux)
    white, options = 2**bits - 1, dataclasses.replace(REAL, bits=bits)
    shown = exposure.develop_picture(
        options, jnp.asarray(luma), jnp.float32(lux), jnp.float32(time), jnp.float32(gain), key
    )
    random = np.asarray(jax.random.normal(key, (4, 5)))
    plain = [
        exposure_plain.level(6000 * lux * time * e, z, gain, 18.0, 10_000.0, white)
        for e, z in zip(luma.flat, random.flat, strict=True)
    ]
    # float32 may round a level that is nearly half way to the other side.
    difference = np.abs(np.asarray(shown).ravel() * white - plain)
    assert difference.max() <= 1.001 and np.mean(difference > 0.01) <= 0.05


QUIET = dataclasses.replace(REAL, read_noise_e=0.0, full_well_e=1e12, sensitivity_e_lux_s=1e12)
"""So many electrons that their noise is nothing."""


def taken(options: ExposureConfig, luma, lux: float, time: float, gain: float = 1.0, seed: int = 0) -> np.ndarray:
    args = (jnp.float32(lux), jnp.float32(time), jnp.float32(gain), jax.random.key(seed))
    return np.asarray(exposure.develop_picture(options, jnp.asarray(luma), *args))


def test_quantisation_errs_by_at_most_half_a_level():
    luma = np.linspace(0.0, 1.0, 5000, dtype=np.float32)
    error = np.abs(taken(QUIET, luma, 100.0, 0.01) - luma) * 255
    assert error.max() <= 0.5 + 1e-3 and error.max() > 0.49
    assert np.unique(taken(QUIET, luma, 100.0, 0.01)).size == 256


def test_twelve_bits_resolve_the_shade_that_eight_do_not():
    luma = np.linspace(0.0, 0.004, 200, dtype=np.float32)  # of white: one level of 8 bits
    shown = {bits: taken(dataclasses.replace(QUIET, bits=bits), luma, 100.0, 0.01) for bits in (8, 12)}
    assert np.unique(shown[8]).size == 2 and np.unique(shown[12]).size == 17


def test_exposure_follows_the_light_with_its_time_constant():
    config = config_of("frames", dataclasses.replace(REAL, metering_s=0.5))
    metered = jnp.float32(0.04)
    for decision in range(1, 5):
        metered = exposure.follow_brightness(config, metered, jnp.float32(0.4))
        # A decision is 0.26 s; in the logarithm what is left of a factor of ten decays.
        assert np.log10(float(metered) / 0.4) == pytest.approx(-np.exp(-0.26 * decision / 0.5), abs=1e-4)
    at_once = exposure.follow_brightness(config_of("frames"), jnp.float32(0.04), jnp.float32(0.4))
    assert float(at_once) == pytest.approx(0.4)
    black = exposure.follow_brightness(config, jnp.float32(0.0), jnp.float32(0.0))
    assert float(black) == pytest.approx(exposure.DARKEST)


def test_the_mean_of_many_noisy_frames_is_the_ideal_one():
    luma = np.linspace(0.05, 0.9, 12, dtype=np.float32)
    shown = taken(REAL, np.broadcast_to(luma, (20_000, 12)), 10.0, 0.015)  # 45 to 810 electrons
    wanted = 6000 * 10.0 * 0.015 * luma / 10_000
    # 20 000 frames: a standard error of at most 33.6 electrons / sqrt(20 000), or 0.24.
    np.testing.assert_allclose(shown.mean(0), wanted, atol=5 * 0.24 / 10_000)


@pytest.mark.parametrize("electrons", [100.0, 1000.0, 9000.0])
def test_noise_is_that_of_photons_and_of_reading(electrons):
    luma = np.full(40_000, electrons / 10_000, np.float32)
    found = taken(REAL, luma, 10_000 / 6000, 1.0, gain=1.0) * 10_000
    level = 10_000 / 255  # electrons, whose rounding has a variance of a twelfth of their square
    wanted = np.sqrt(electrons + 18.0**2 + level**2 / 12)
    if electrons > 500:  # where rounding is as random as this
        assert abs(found.std() / wanted - 1) < 0.02  # 40 000 numbers: 0.35 %
    assert abs(found.mean() - electrons) < 1.0


def test_less_light_is_noisier_and_too_much_clips():
    luma, noise, means = np.full(20_000, 0.5, np.float32), [], []
    for lux in (0.1, 1.0, 10.0, 100.0, 1000.0, 10_000.0):
        time, gain = exposure.exposure_settings(REAL, jnp.float32(lux), jnp.float32(0.5))
        picture = taken(REAL, luma, lux, float(time), float(gain))
        noise.append(picture.std() / picture.mean())
        means.append(picture.mean())
    assert noise[:4] == sorted(noise[:4], reverse=True)
    assert noise[0] > 1.0 > 0.05 > noise[3]  # nothing to see in moonlight, and a clean picture indoors
    np.testing.assert_allclose(means[3:], 0.4, rtol=0.01)
    assert means[0] < 0.05
    white = taken(REAL, np.array([0.2, 0.9, 1.0], np.float32), 10_000.0, 0.001)
    assert white.tolist() == [1.0, 1.0, 1.0]


@pytest.fixture(scope="module")
def scene():
    return mjcf.load_scene(WORLD)


@partial(jax.jit, static_argnums=0)
def shown(config, scene, poses, lux, metered, key):
    return sensor.sense(config, scene, poses, FrameMemory(lux, metered), key)


def poses_of(config: Config, position, quaternion) -> Flight:
    return Flight(*(jnp.asarray(x, jnp.float32) for x in (position, quaternion, position)))


def perfect(config: Config, scene, position, yaw: float) -> np.ndarray:
    attitude = jnp.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    return np.asarray(jax.jit(lambda p: sensor.render_view(config, scene, p, attitude))(jnp.asarray(position)))


HERE = np.array([5.0, 5.0, 3.0])
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def luma_of(config: Config, sensed) -> np.ndarray:
    return np.exp(np.asarray(sensed)[0] + sensor.MID_GREY) - config.events.log_epsilon


def test_a_camera_that_stands_still_has_no_blur(scene):
    config = config_of("frames", QUIET)
    poses = poses_of(config, np.tile(HERE, (2, 1)), np.tile(UPRIGHT, (2, 1)))
    # The exposure that makes white white: metered brightness is the target.
    sensed, memory = shown(config, scene, poses, jnp.float32(100.0), jnp.float32(0.4), jax.random.key(0))
    ideal = perfect(config, scene, HERE, 0.0)
    assert np.abs(luma_of(config, sensed) - ideal).max() <= 0.5 / 255 + 1e-5
    assert abs(float(memory.metered) - ideal.mean()) < 1e-3 and float(memory.lux) == 100.0


def test_a_turning_camera_smears_what_it_sees_over_its_exposure(scene):
    """The picture is the mean of perfect ones from the middle of each fifth of the exposure."""
    slow = dataclasses.replace(QUIET, sensitivity_e_lux_s=6000.0, full_well_e=10_000.0, shortest_s=0.02)
    config = config_of("frames", slow)
    yaws = (0.0, 0.3)
    attitudes = np.array([[np.cos(a / 2), 0.0, 0.0, np.sin(a / 2)] for a in yaws])
    poses = poses_of(config, np.stack([HERE, HERE + 0.08]), attitudes)
    # So many lux fill the well in 0.02 s.
    lux, many = jnp.float32(10_000 / (6000 * 0.02)), jax.random.split(jax.random.key(1), 200)
    sensed = jax.vmap(lambda key: shown(config, scene, poses, lux, jnp.float32(0.4), key)[0])(many)
    mean = np.mean([luma_of(config, each) for each in sensed], axis=0)
    shares = 1.0 - (np.arange(5) + 0.5) / 5
    views = []
    for share in shares:
        mixed = (1 - share) * attitudes[0] + share * attitudes[1]
        views.append(perfect(config, scene, HERE + 0.08 * share, 2 * np.arctan2(mixed[3], mixed[0])))
    wanted = np.mean(views, axis=0)
    # 200 pictures with a noise of 0.01 each, clipped at white.
    inside = wanted < 0.95
    assert np.abs(mean - wanted)[inside].max() < 0.005
    assert np.abs(wanted - views[0]).max() > 0.03 and inside.mean() > 0.5


@pytest.mark.whole
@pytest.mark.slow
def test_what_moves_is_smeared_where_the_drone_stands_still():
    """Each part of an exposure sees the world at its own time."""
    slow = dataclasses.replace(REAL, shortest_s=0.02, read_noise_e=0.0)
    config = dataclasses.replace(config_of("frames", slow), world=WorldConfig(name="moving", moving_speed_m_s=5.0))
    scene, rng = edqn_jax.make("moving", config, seed=1).scene(0), np.random.default_rng(0)
    at = jax.jit(lambda t, p: sensor.render_view(config, scene_at(scene, t), p, jnp.asarray(UPRIGHT)))
    # Somewhere where something moves in the picture.
    places = [np.array([x, y, 3.0], np.float32) for x, y in rng.uniform(10.0, 90.0, (60, 2))]
    place = max(places, key=lambda p: np.abs(at(4.0, p) - at(4.02, p)).max())
    still = np.tile(place, (2, 1)), np.tile(UPRIGHT, (2, 1)), np.tile(place, (2, 1)), [4.0, 4.02]
    poses = Flight(*(jnp.asarray(x, jnp.float32) for x in still))
    lux, many = jnp.float32(10_000 / (6000 * 0.02)), jax.random.split(jax.random.key(1), 300)
    sensed = jax.vmap(lambda key: shown(config, scene, poses, lux, jnp.float32(0.4), key)[0])(many)
    mean = np.mean([luma_of(config, each) for each in sensed], axis=0)
    wanted = np.mean([at(4.02 - 0.02 * (k + 0.5) / 5, place) for k in range(5)], axis=0)
    sharp = np.asarray(at(4.02, place))
    inside = wanted < 0.95
    # 300 pictures with a noise of at most 0.01 each.
    assert np.abs(mean - wanted)[inside].max() < 0.003 < 0.006 < np.abs(wanted - sharp)[inside].max()


@pytest.mark.slow
def test_a_pair_of_real_frames_has_one_exposure_and_its_change(scene):
    config = config_of("frame-pair", QUIET)
    place = np.concatenate([np.tile(HERE, (2, 1)), np.tile(HERE + [0.3, 0.1, 0.0], (2, 1))])
    poses = poses_of(config, place, np.tile(UPRIGHT, (4, 1)))
    sensed, _ = shown(config, scene, poses, jnp.float32(1000.0), jnp.float32(0.4), jax.random.key(0))
    before, after = perfect(config, scene, place[0], 0.0), perfect(config, scene, place[-1], 0.0)
    assert np.abs(luma_of(config, sensed) - after).max() <= 0.5 / 255 + 1e-5
    change = np.log(after + 1e-3) - np.log(before + 1e-3)
    bright = np.minimum(after, before) > 0.2  # half a level of 51 is 1 %
    np.testing.assert_allclose((np.asarray(sensed)[1] * built_in.CHANGE_SCALE)[bright], change[bright], atol=0.021)
    assert np.abs(change[bright]).max() > 0.1


def test_the_camera_adapts_to_the_light_within_two_decisions():
    pool = stack_scenes([mjcf.load_scene(WORLD)])
    config = dataclasses.replace(config_of("frames"), light=LightConfig(300.0, 300.0))
    world = env.EnvParams(load_airframe(config.drone), pool, own_missions(pool))
    state, _ = jax.jit(lambda key: env.reset(config, world, key))(jax.random.key(0))
    step = jax.jit(lambda s: env.step(config, world, s, 13))
    for _ in range(2):
        state, seen = step(state)
    assert float(state.memory.lux) == pytest.approx(300.0, rel=1e-5)
    level = luma_of(config, seen.observation.sensed)
    assert abs(level.mean() - 0.4) < 0.02 and level.std() > 0.05
    fresh, _ = step(dataclasses.replace(state, ended=jnp.ones((), bool)))
    assert fresh.memory.metered != exposure.AT_REST


@pytest.mark.parametrize(("name", "pictures"), [("frames", 5), ("frame-pair", 10), ("events", 2)])
def test_pictures_that_a_decision_draws(name, pictures):
    assert sensor.frames_per_decision(config_of(name)) == pictures
    long = dataclasses.replace(REAL, longest_s=0.03)
    assert exposure.steps_touched(long, 0.02) == 2 and exposure.steps_touched(REAL, 0.02) == 1
    steps = {"frames": (11, 12, 13), "frame-pair": (9, 10, 11, 11, 12, 13), "events": (11, 13)}
    assert sensor.frame_steps(config_of(name, long)) == steps[name]


def test_exposures_that_cannot_be_are_said():
    with pytest.raises(ConfigError, match="exposure.real must be false without light.least_lux and light.most_lux"):
        validate(dataclasses.replace(config_of("frames"), light=LightConfig()))
    with pytest.raises(ConfigError, match="exposure.longest_s must be at most 0.22, the seconds of a decision before"):
        validate(config_of("frames", dataclasses.replace(REAL, longest_s=0.23)))
    with pytest.raises(ConfigError, match=r"exposure.shortest_s must be at most exposure.longest_s \(0.02\)"):
        validate(config_of("frames", dataclasses.replace(REAL, shortest_s=0.03)))
    validate(config_of("frames", dataclasses.replace(REAL, longest_s=0.22)))


def test_a_perfect_camera_carries_nothing_and_draws_no_random_numbers(scene):
    for name in ("frames", "frame-pair"):
        config = config_of(name, ExposureConfig())
        assert sensor.at_rest(config, jax.random.key(0)) is None
        poses = poses_of(config, np.tile(HERE, (2, 1)), np.tile(UPRIGHT, (2, 1)))
        trace = jax.make_jaxpr(lambda k, c=config, p=poses: sensor.sense(c, scene, p, None, k)[0])(jax.random.key(0))
        assert "random" not in str(trace)
