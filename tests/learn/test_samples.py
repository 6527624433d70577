"""The ring that the VAE learns from: what is kept, what is drawn, and that nothing of it is lost."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import CameraConfig, Config, DroneConfig, EncoderConfig, EventsConfig
from edqn_jax.learn import samples
from edqn_jax.learn.perception import vae
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.scene.scene import UprightBoxes, build_scene, stack_scenes
from edqn_jax.sim.task import env
from edqn_jax.sim.task.missions import own_missions
from edqn_jax.sim.task.observation import MIRRORED_MOTION, MOTION_SIZE, Observation
from edqn_jax.sim.task.task import task_of
from tests.oracles import event_fields
from tests.support.marks import rows_in_whole

ENVS, LENGTH = 3, 4
CONFIG = EncoderConfig(replay_size=2 * ENVS * LENGTH, target="sensed", mirror=False)  # of two shards
SMALL = CameraConfig(width=6, height=4)

write = jax.jit(samples.store_samples)
draw = jax.jit(partial(samples.sample_batch, CONFIG), static_argnums=2)


def decision(number: int, config: EncoderConfig = CONFIG, *, even: bool = True) -> samples.Samples:
    """Samples of all environments in one decision; everything in them says which."""
    rng = np.random.default_rng(number)
    counts = rng.integers(-5, 6, (ENVS, SMALL.height, SMALL.width)).astype(np.int8)
    field = jax.vmap(lambda c: event_fields.field_of_counts(EventsConfig(), c))(jnp.asarray(counts))
    field = dataclasses.replace(field, divides_window=even)
    motion = jnp.full((ENVS, MOTION_SIZE), float(number)) + jnp.arange(ENVS)[:, None] / 10.0
    observation = Observation(field, jnp.zeros((ENVS, 10)), motion)
    return samples.samples_of(config, observation, samples.target_of(config, observation, None))


def ring_after(kept: list[bool]) -> tuple[samples.Samples, int]:
    one = jax.tree.map(lambda x: x[0], decision(0))
    ring, time = samples.empty_ring(CONFIG, one, ENVS, 2 * ENVS), 0
    for number, keep in enumerate(kept):
        ring = write(ring, decision(number), jnp.int32(time), jnp.asarray(keep))
        time += keep
    return ring, time


@pytest.mark.parametrize(
    ("kept", "expected"),
    [
        ([True, True], {0, 1}),
        ([True, False, False, True], {0, 3}),
        ([True] * 7, {3, 4, 5, 6}),  # the ring has gone round
        ([True, False] * 6, {4, 6, 8, 10}),
    ],
)
@pytest.mark.slow
def test_what_was_kept_last_is_drawn_and_nothing_else(kept, expected) -> None:
    ring, time = ring_after(kept)
    drawn = draw(ring, jnp.int32(time), 256, jax.random.key(0))
    numbers, envs = np.divmod(np.rint(10 * np.asarray(drawn.motion[:, 0])).astype(int), 10)
    assert set(numbers) == expected and set(envs) == set(range(ENVS))
    # Uniform: 256 draws of at most 12 samples; five standard deviations below the mean of 21 is 0.
    assert np.bincount(numbers)[sorted(expected)].min() > 256 / len(expected) / 2


def test_what_is_drawn_belongs_together() -> None:
    ring, time = ring_after([True] * 3)
    drawn = draw(ring, jnp.int32(time), 64, jax.random.key(1))
    for index in range(0, 64, 7):
        number, env = divmod(round(10 * float(drawn.motion[index, 0])), 10)
        source = jax.tree.map(lambda x, env=env: x[env], decision(number))
        jax.tree.map(lambda x, y, at=index: np.testing.assert_array_equal(x[at], y), drawn, source)


@pytest.mark.whole
@pytest.mark.parametrize(
    ("architecture", "even", "alone"),
    [
        ("patches", True, True),
        *rows_in_whole(("patches", False, True), ("pooled", True, True)),
        ("pooled", False, False),
    ],
)
@pytest.mark.slow
def test_what_is_stored_is_encoded_as_what_was_seen(architecture, even, alone) -> None:
    config = EncoderConfig(architecture=architecture, code_size=4, replay_size=64, target="sensed", features=4)
    field = jax.vmap(lambda c: event_fields.field_of_counts(EventsConfig(), c))(
        jnp.asarray(np.random.default_rng(3).integers(-200, 200, (ENVS, SMALL.height, SMALL.width)))
    )
    field = dataclasses.replace(field, divides_window=even)
    motion = jnp.asarray(np.random.default_rng(4).normal(size=(ENVS, MOTION_SIZE)), jnp.float32)
    observation = Observation(field, motion, motion)
    wanted = samples.target_of(config, observation, None)
    stored = samples.samples_of(config, observation, wanted)
    assert isinstance(stored.sensed, samples.Counts) == alone
    params = vae.init_vae(config, SMALL, jax.random.key(0))
    read, shown = (vae.encode(config, params, sensed, motion) for sensed in (samples.to_encoder_input(stored), field))
    for one, two in zip(read, shown, strict=True):
        np.testing.assert_array_equal(one, two)


def test_half_of_what_is_drawn_is_mirrored() -> None:
    ring, time = ring_after([True] * 3)
    mirroring = dataclasses.replace(CONFIG, mirror=True)
    mirror = jax.jit(partial(samples.sample_batch, mirroring, task=task_of(Config())), static_argnums=2)
    turned = np.asarray(mirror(ring, jnp.int32(time), 256, jax.random.key(2)).motion[:, 1])
    # The motion of one sample in nine is 0, the same either way.
    assert (turned[:128] <= 0.0).all() and (turned[128:] >= 0.0).all()
    assert (turned[:128] < 0.0).sum() > 90 and (turned[128:] > 0.0).sum() > 90


def test_a_mirrored_sample_is_that_of_the_mirrored_image() -> None:
    rng = np.random.default_rng(6)
    counts = rng.integers(-5, 6, (SMALL.height, SMALL.width)).astype(np.int8)
    near = jnp.asarray(rng.random((SMALL.height, SMALL.width)), jnp.float32)
    config = dataclasses.replace(CONFIG, target="both")
    motion = jnp.arange(1.0, 1.0 + MOTION_SIZE)

    def sample(counts: np.ndarray, near: jax.Array, motion: jax.Array) -> samples.Samples:
        field = event_fields.field_of_counts(EventsConfig(), jnp.asarray(counts))
        observation = Observation(field, motion, motion)
        return samples.samples_of(config, observation, samples.target_of(config, observation, near))

    got = samples.mirror_samples(sample(counts, near, motion), MIRRORED_MOTION)
    # To the left, turning left and the move to the left become those to the right.
    expected = sample(counts[:, ::-1], near[:, ::-1], jnp.array([1.0, -2, 3, -4, 5, -6, 7]))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-5), got, expected)


@pytest.mark.whole
@pytest.mark.slow
def test_a_flight_to_the_right_is_the_mirror_of_one_to_the_left() -> None:
    """In a world that is its own mirror: what is seen and known of one's motion, the signs of `MIRRORED_MOTION`."""
    config = Config(
        drone=DroneConfig(physics="rigid_body"),
        camera=CameraConfig(texture_contrast=0.0, ambient=1.0),
        events=EventsConfig(threshold=0.01, tolerance=0.01),
    )
    shapes = [
        UprightBoxes(*map(np.asarray, ([14.0, side * 3, 3], [2.0, 1, 3], 0.0, [0.9] * 3)))  # pyright: ignore
        for side in (-1.0, 1.0)
    ]
    scene = build_scene(shapes, volume=[[-9, -15, 0], [40, 15, 20]], start=[0, 0, 4], goal=[30, 0, 4])
    pool = stack_scenes([scene])
    world = env.EnvParams(load_airframe(config.drone), pool, own_missions(pool))
    fresh, _ = env.reset(config, world, jax.random.key(0), jnp.asarray(0))
    step = jax.jit(partial(env.step, config, world))

    def flown(side: int) -> samples.Samples:
        state = fresh
        for move in ((1, side, 0), (1, side, 1)):
            number = np.flatnonzero((ACTIONS == move).all(axis=1))[0]
            state, seen = step(state, jnp.asarray(number))
        wanted = samples.target_of(EncoderConfig(), seen.observation, env.nearness(config, world, state))
        return samples.samples_of(EncoderConfig(), seen.observation, wanted)

    left, right = flown(1), samples.mirror_samples(flown(-1), MIRRORED_MOTION)
    assert np.abs(left.sensed.signed).sum() > 20  # type: ignore[union-attr]
    # A pixel on an edge may round the other way and then have an event more or less.
    assert np.mean(np.asarray(left.sensed.signed) != np.asarray(right.sensed.signed)) < 0.01  # type: ignore[union-attr]
    np.testing.assert_allclose(left.motion, right.motion, atol=1e-4)
    np.testing.assert_allclose(left.wanted.amplitudes, right.wanted.amplitudes, atol=1e-2)
