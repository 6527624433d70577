"""The contrast of an episode, drawn and known to the networks, what counts mean under it, and faults that are drawn."""

# pyright: reportArgumentType=false

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import CameraConfig, Config, DroneConfig, EventsConfig
from edqn_jax.config.loading import make_config, with_conditions
from edqn_jax.errors import ConfigError
from edqn_jax.learn import actor, samples
from edqn_jax.learn.perception import vae
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.scene import stack_scenes
from edqn_jax.sim.sensors import contrast, event_field, event_memory
from edqn_jax.sim.task import env
from edqn_jax.sim.task.missions import own_missions
from edqn_jax.sim.task.observation import MOTION_SIZE, OWN_SIZE, rotate_own_state
from edqn_jax.sim.task.task import task_of
from tests.support.event_frames import ESIM, PAPER, host, memory_of, random_frames, run
from tests.support.miniature import WORLD

DRAWN = Config(
    camera=CameraConfig(width=16, height=12),
    drone=DroneConfig(physics="rigid_body"),
    events=EventsConfig(least_contrast=0.02, most_contrast=0.3),
)
FAULTY = dataclasses.replace(
    PAPER, threshold_mismatch=0.25, leak_rate_hz=20.0, shot_rate_hz=50.0, bandwidth_hz=30.0, faults_share=1.0
)


def told(config: EventsConfig, value: float) -> EventsConfig:
    return dataclasses.replace(config, least_contrast=value, most_contrast=value)


def test_a_contrast_is_log_uniform_and_known_from_about_minus_1_to_1():
    draw = jax.vmap(lambda key: contrast.sample_contrast(DRAWN.events, key))
    drawn = np.asarray(draw(jax.random.split(jax.random.key(0), 4000)))
    assert 0.02 <= drawn.min() and drawn.max() <= 0.3
    # 4000 draws: the standard error of a quarter is 0.7 %.
    edges = np.geomspace(0.02, 0.3001, 5)
    np.testing.assert_allclose(np.histogram(drawn, edges)[0] / 4000, 0.25, atol=0.03)
    values = contrast.value_of(jnp.asarray(drawn))
    assert -1.01 < values.min() < -0.98 and 0.98 < values.max() < 1.01
    np.testing.assert_allclose(contrast.contrast_of(values), drawn, rtol=1e-5)


@pytest.mark.whole
def test_an_episode_keeps_its_contrast_which_own_state_and_motion_end_with():
    pool = stack_scenes([load_scene(WORLD)])
    world = env.EnvParams(load_airframe(Config().drone), pool, own_missions(pool))
    state, seen = jax.jit(lambda key: env.reset(DRAWN, world, key))(jax.random.key(0))
    step = jax.jit(lambda s: env.step(DRAWN, world, s, 13))
    after, taken = step(state)
    assert state.memory.contrast == after.memory.contrast and 0.02 <= state.memory.contrast <= 0.3
    fresh, again = step(dataclasses.replace(after, ended=jnp.ones((), bool)))
    assert fresh.memory.contrast != state.memory.contrast
    for memory, observation in ((state, seen), (after, taken.observation), (fresh, again.observation)):
        known = contrast.value_of(memory.memory.contrast)
        assert observation.own.shape == (OWN_SIZE + 1,) and observation.motion.shape == (MOTION_SIZE + 1,)
        np.testing.assert_allclose([observation.own[-1], observation.motion[-1]], known, atol=1e-6)
        assert observation.sensed.unit == pytest.approx(memory.memory.contrast / contrast.REFERENCE)
    blank = actor.blank_observation(DRAWN)
    assert jax.tree.structure(blank) == jax.tree.structure(seen)
    assert jax.tree.map(jnp.shape, blank) == jax.tree.map(jnp.shape, seen)


def test_only_sensors_of_events_have_a_contrast_to_know():
    for sensor in ("depth", "blind", "frames"):
        other = dataclasses.replace(DRAWN, env=dataclasses.replace(DRAWN.env, sensor=sensor))
        assert task_of(other).own_size == OWN_SIZE and task_of(other).motion_size == MOTION_SIZE
    task = task_of(DRAWN)
    assert task.own_size == OWN_SIZE + 1 and task.mirror is not None
    assert len(task.mirror) == task.motion_size and task.mirror[-1] == 1.0
    assert rotate_own_state(jnp.arange(11.0), jnp.int32(1))[-1] == 10.0


@pytest.mark.parametrize("law", [PAPER, dataclasses.replace(ESIM, refractory_ns=1.0)], ids=["paper", "esim"])
def test_a_contrast_scales_every_threshold(law):
    scale = 0.5
    configured = dataclasses.replace(
        law,
        **{name: scale * getattr(law, name) for name in ("threshold", "tolerance", "contrast_on", "contrast_off")},
    )
    drawn = told(law, scale * contrast.nominal_contrast(law))
    frames = random_frames(1)
    fields = []
    for config in (configured, drawn):
        memory = memory_of(config, 0)
        if memory.residual is not None:
            memory = dataclasses.replace(memory, residual=jnp.zeros_like(memory.residual))
        fields.append(host(run(config, memory, frames)[0]))
    np.testing.assert_array_equal(fields[0].count, fields[1].count)
    np.testing.assert_array_equal(fields[0].polarity, fields[1].polarity)


def test_what_is_encoded_is_the_change_of_log_brightness_whatever_the_contrast():
    luma = np.exp(np.array([-3.0, -1.8])) - PAPER.log_epsilon
    frames = np.broadcast_to(luma[:, None, None], (2, 4, 5)).astype(np.float32)
    unbound = dataclasses.replace(PAPER, refractory_ns=1000.0)
    for value in (0.3, 0.1, 0.02):
        config = told(dataclasses.replace(unbound, threshold=unbound.tolerance), value)
        field = run(config, memory_of(config, 0), frames, (-0.04, 0.0))[0]
        read = np.asarray(event_field.in_units(field)) * contrast.REFERENCE
        np.testing.assert_allclose(read, 1.2, atol=value)
        np.testing.assert_allclose(
            event_field.image_in_units(field), np.sum(read, axis=0) / contrast.REFERENCE, rtol=1e-5
        )
        target = vae.decoder_target(dataclasses.replace(DRAWN.encoder, target="sensed", target_blur=0), field)
        np.testing.assert_allclose(target[0], np.log1p(read[0] / contrast.REFERENCE), rtol=1e-5)


def test_what_is_stored_and_mirrored_keeps_its_units():
    config = told(PAPER, 0.2)
    field = jax.tree.map(lambda x: jnp.stack([x, x]), run(config, memory_of(config, 0), random_frames(1))[0])
    field = dataclasses.replace(field, unit=jnp.array([4.0, 2.0]))
    encoder = DRAWN.encoder
    observation = dataclasses.replace(
        actor.blank_observation(DRAWN), sensed=field, motion=jnp.ones((2, MOTION_SIZE + 1))
    )
    wanted = vae.Target(jnp.zeros((2, 1, 3, 3)), jnp.zeros(2))
    kept = samples.samples_of(encoder, observation, wanted)
    read = samples.to_encoder_input(kept)
    np.testing.assert_allclose(event_field.in_units(read), field.count * np.array([4.0, 2.0])[:, None, None, None])
    turned = samples.to_encoder_input(samples.mirror_samples(kept, task_of(DRAWN).mirror))
    np.testing.assert_array_equal(event_field.in_units(turned), event_field.in_units(read)[..., ::-1])


# ---------------------------------------------------------------------------------------- conditions


def test_thresholds_given_to_a_policy_that_knows_its_contrast_are_what_it_is_told():
    config = make_config("medium", events={"profile": "dvs", "faults_share": 1.0} | drawn_from(0.02, 0.3))
    flown = with_conditions(config, {"events": {"profile": "dvs", "threshold": 0.2}}, "test").events
    assert (flown.least_contrast, flown.most_contrast, flown.faults_share) == (0.2, 0.2, 0.0)
    flown = with_conditions(config, {"events": {"threshold": 0.1, "tolerance": 0.1}}, "test").events
    assert (flown.least_contrast, flown.most_contrast, flown.faults_share) == (0.1, 0.1, 1.0)
    flown = with_conditions(config, {"events": drawn_from(0.1, 0.15)}, "test").events
    assert (flown.least_contrast, flown.most_contrast) == (0.1, 0.15)
    assert with_conditions(config, {"events": {"leak_rate_hz": 1.0}}, "test").events.most_contrast == 0.3


def drawn_from(least: float, most: float) -> dict[str, float]:
    return {"least_contrast": least, "most_contrast": most}


def test_a_contrast_is_neither_given_to_a_policy_that_knows_none_nor_taken_away():
    plain = make_config("medium")
    with pytest.raises(ConfigError, match="knows no contrast; give events.threshold"):
        with_conditions(plain, {"events": drawn_from(0.1, 0.2)}, "test")
    knows = make_config("medium", events=drawn_from(0.02, 0.3))
    with pytest.raises(ConfigError, match=r"must be between 0.01 and 1, not 0 and 0"):
        with_conditions(knows, {"events": drawn_from(0.0, 0.0)}, "test")


# -------------------------------------------------------------------------------------------- faults


def test_each_episode_has_a_share_of_the_faults():
    shares = np.array([float(memory_of(FAULTY, seed).faults) for seed in range(40)])
    assert shares.min() > 0 and shares.max() <= 1 and shares.std() > 0.2
    half = dataclasses.replace(FAULTY, faults_share=0.5)
    assert min(float(memory_of(half, seed).faults) for seed in range(40)) >= 0.5


@pytest.mark.parametrize("share", [1.0, 0.3, event_memory.LEAST_SHARE])
def test_a_sensor_with_a_share_of_its_faults_is_one_of_smaller_faults(share):
    whole = dataclasses.replace(FAULTY, faults_share=0.0)
    lesser = dataclasses.replace(
        whole,
        threshold_mismatch=share * whole.threshold_mismatch,
        leak_rate_hz=share * whole.leak_rate_hz,
        shot_rate_hz=share * whole.shot_rate_hz,
        refractory_ns=share * whole.refractory_ns,
        bandwidth_hz=whole.bandwidth_hz / share,
    )
    frames = np.tile(random_frames(1), (1, 16, 16))
    memory = memory_of(lesser, 0, *frames.shape[1:])
    drawn = dataclasses.replace(memory, faults=jnp.float32(share))
    wanted, found = host(run(lesser, memory, frames)[0]), host(run(FAULTY, drawn, frames)[0])
    # Signal alike; noise of the same rates, drawn otherwise: of some 5000 pixels, four standard errors.
    noise = 4 * (5120 * 3 * 0.04 * (45.0 + 0.0)) ** 0.5 * share**0.5
    assert abs(int(wanted.count.sum()) - int(found.count.sum())) <= max(noise, 5)
    assert wanted.count.sum() > 1000
