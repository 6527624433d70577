"""The patch encoder: held against its event-by-event twin; what it reads, and what it must not."""

from __future__ import annotations

import dataclasses
import shutil
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from edqn_jax.config import CameraConfig, EncoderConfig, EventsConfig
from edqn_jax.learn.perception import vae
from edqn_jax.learn.perception.code import Form
from edqn_jax.learn.perception.patch_encoder import log_counts
from edqn_jax.learn.perception.patches import TARGET
from edqn_jax.native.own_programs import own_program
from edqn_jax.native.products import in_precision
from edqn_jax.sim.sensors import event_field
from edqn_jax.sim.task.observation import MOTION_SIZE
from tests.oracles import event_fields, patch_encoder_plain
from tests.support.marks import in_whole, rows_in_whole

SMALL = CameraConfig(width=10, height=6)  # no multiple of a patch's side
CONFIG = EncoderConfig(code_size=5, patch_layers=(6, 3), joint_layers=(8, 7))
MOTION = np.random.default_rng(9).normal(size=MOTION_SIZE).astype(np.float32)

fresh = jax.jit(vae.init_vae, static_argnums=(0, 1), static_argnames=("form", "layers"))
encode = jax.jit(vae.encode, static_argnums=0)


def shaken(params, key: int = 5):
    """Parameters with biases and log-variances that are not zero."""
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(key), len(leaves))
    return jax.tree.unflatten(
        tree, [x + 0.3 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    )


def random_field(seed: int, pairs: int, *, noise: bool = False) -> event_field.EventField:
    """Counts of 0 to 6, either polarity; with noise, rows of ON events and as many of OFF events."""
    rng = np.random.default_rng(seed)
    shape = (pairs * (2 if noise else 1), SMALL.height, SMALL.width)
    count = rng.poisson(0.7, shape).astype(np.int32)
    sign = np.repeat([1, -1], pairs)[:, None, None] if noise else rng.choice([-1, 1], shape)
    polarity = np.where(count > 0, sign, 0).astype(np.int8)
    times = np.zeros(shape, np.float32)
    field = event_field.EventField(*map(jnp.asarray, (count, polarity, times, times)), window_s=0.04, with_noise=noise)  # pyright: ignore
    return field


def single_events(field: event_field.EventField, pairs: int) -> list[patch_encoder_plain.Event]:
    """All events one by one, in an arbitrary order; rows of OFF events follow those of ON events."""
    found = []
    for row, y, x in np.argwhere(np.asarray(field.count) > 0):
        event = (int(row) % pairs, int(x), int(y), int(field.polarity[row, y, x]))
        found += [event] * int(field.count[row, y, x])
    return [found[at] for at in np.random.default_rng(1).permutation(len(found))]


@pytest.mark.whole
@pytest.mark.parametrize(
    ("pairs", "noise", "overlap"),
    [(1, True, 0), (2, False, 2), *rows_in_whole((1, False, 0), (2, False, 0), (2, True, 0))],
)
@pytest.mark.slow
def test_dense_codes_are_those_of_single_events(pairs: int, noise: bool, overlap: int) -> None:
    config = dataclasses.replace(CONFIG, patch_overlap=overlap)
    params = shaken(fresh(config, SMALL, jax.random.key(0), layers=pairs))
    field = random_field(pairs, pairs, noise=noise)
    dense = encode(config, params, field, MOTION)
    one_by_one = jax.tree.map(lambda x: np.asarray(x, np.float64), params["encoder"])
    size, events = (SMALL.height, SMALL.width), single_events(field, pairs)
    plain = patch_encoder_plain.code(one_by_one, events, MOTION, pairs, size, CONFIG.patch_pixels, overlap)
    for got, expected in zip(dense, plain, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-4)  # float32 sums of order 1


def test_both_polarities_of_a_pixel_are_counted_apart() -> None:
    blank = np.zeros((2, 1, 1), np.int32)
    blank[:, 0, 0] = 3, 2  # three ON events, two OFF events in the same frame pair
    polarity = np.array([1, -1], np.int8).reshape(2, 1, 1)
    times = jnp.zeros((2, 1, 1))
    field = event_field.EventField(jnp.asarray(blank), jnp.asarray(polarity), times, times, 0.04, with_noise=True)
    np.testing.assert_allclose([float(x[0, 0]) for x in log_counts(field, 1)], np.log([4.0, 3.0]), rtol=1e-6)


def test_the_same_events_mean_something_else_under_another_motion() -> None:
    params = fresh(CONFIG, SMALL, jax.random.key(0))
    field = random_field(1, 1)
    codes = [encode(CONFIG, params, field, jnp.asarray(motion))[0] for motion in (MOTION, -MOTION)]
    assert np.abs(codes[0] - codes[1]).max() > 0.1


def test_a_batch_is_encoded_as_its_fields_are_one_by_one() -> None:
    params = shaken(fresh(CONFIG, SMALL, jax.random.key(0)))
    fields = [random_field(seed, 1) for seed in range(4)]
    motion = jnp.asarray(np.random.default_rng(2).normal(size=(4, MOTION_SIZE)), jnp.float32)
    whole = encode(CONFIG, params, jax.tree.map(lambda *x: jnp.stack(x), *fields), motion)
    single = [encode(CONFIG, params, field, each) for field, each in zip(fields, motion, strict=True)]
    for got, expected in zip(whole, zip(*single, strict=True), strict=True):
        np.testing.assert_allclose(got, np.stack(expected), rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_a_picture_is_read_as_one_channel_of_events_is() -> None:
    params = shaken(fresh(CONFIG, SMALL, jax.random.key(0), form=Form.PICTURE))
    field = random_field(1, 1)
    field = dataclasses.replace(field, polarity=jnp.abs(field.polarity))  # ON alone
    both = fresh(CONFIG, SMALL, jax.random.key(1))
    shared = {"encoder": {**both["encoder"], **params["encoder"]}}
    picture = jnp.log(1.0 + field.count)
    for got, expected in zip(
        encode(CONFIG, params, picture, MOTION), encode(CONFIG, shared, field, MOTION), strict=True
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("target", "form", "channels"),
    [
        ("both", Form.EVENTS, 3),
        ("both", Form.PICTURE, 2),
        *rows_in_whole(("sensed", Form.EVENTS, 2), ("nearness", Form.EVENTS, 1), ("nearness", Form.PICTURE, 1)),
    ],
)
@pytest.mark.slow
def test_the_decoder_draws_what_the_target_holds(target, form, channels) -> None:
    config = dataclasses.replace(CONFIG, target=target, target_blur=0)
    params = fresh(config, SMALL, jax.random.key(0), form=form)
    sensed = random_field(3, 1) if form is Form.EVENTS else jnp.ones((1, SMALL.height, SMALL.width))
    near = jnp.asarray(np.random.default_rng(4).random((SMALL.height, SMALL.width)), jnp.float32)
    image = vae.decoder_target(config, sensed, near)
    assert image.shape == vae.decode(config, SMALL, params, jnp.zeros(5)).shape == (channels, SMALL.height, SMALL.width)
    if target != "sensed":
        np.testing.assert_array_equal(image[-1], near)
    if target != "nearness":
        np.testing.assert_array_equal(
            image[: channels - (target == "both")],
            vae.decoder_target(dataclasses.replace(config, target="sensed"), sensed),
        )


@pytest.mark.whole
@pytest.mark.slow
@pytest.mark.parametrize("products", ["float32", *in_whole("bfloat16")])
def test_nearness_is_learnt_from_events_and_motion_and_not_from_events_alone(products: str) -> None:
    """A patch of k events at speed v stands for a nearness of k / (8 v): only both together tell it."""
    camera, config = CameraConfig(width=8, height=8), EncoderConfig(code_size=4, kl_weight=0.0, target_blur=0)
    rng = np.random.default_rng(0)
    speed = rng.uniform(0.5, 1.0, 512).astype(np.float32)
    near = rng.uniform(0.2, 1.0, 512).astype(np.float32)
    counts = np.rint(16 * near * speed).astype(np.int8)
    fields = jax.vmap(partial(event_fields.field_of_counts, EventsConfig()))(
        jnp.asarray(np.broadcast_to(counts[:, None, None], (512, 8, 8)))
    )
    motion = np.zeros((512, MOTION_SIZE), np.float32)
    motion[:, 0] = speed
    wanted = vae.in_waves(
        config, vae.decoder_target(config, fields, jnp.asarray(np.broadcast_to(near[:, None, None], (512, 8, 8))))
    )

    optimiser, params = optax.adam(2e-3), fresh(config, camera, jax.random.key(0))

    @jax.jit
    def train(motion):
        def update(carry, key):
            params, state = carry
            noise = jax.random.normal(key, (*wanted.beyond.shape, config.code_size))
            with in_precision(products):
                gradient = jax.grad(lambda p: vae.vae_loss(config, p, fields, motion, wanted, noise)[0])(params)
            change, state = optimiser.update(gradient, state)
            return (optax.apply_updates(params, change), state), None

        keys = jax.random.split(jax.random.key(1), 150)
        (learnt, _), _ = jax.lax.scan(update, (params, optimiser.init(params)), keys)
        return vae.decode(config, camera, learnt, vae.embed(config, learnt, fields, motion))

    with_motion, without = (
        float(np.sqrt(np.mean((np.asarray(train(known))[:, 0].mean((1, 2)) - near) ** 2)))
        for known in (motion, np.zeros_like(motion))
    )
    assert with_motion < 0.5 * without, (with_motion, without)


@pytest.mark.whole
def test_the_gradient_of_rounded_products_is_near_that_of_plain_ones() -> None:
    """bfloat16 rounds by up to 2^-9, through six layers there and back, and a ReLU near 0 opens or closes."""
    camera, config = CameraConfig(width=16, height=12), EncoderConfig()
    params, rng = shaken(fresh(config, camera, jax.random.key(0))), np.random.default_rng(0)
    fields = jax.vmap(partial(event_fields.field_of_counts, EventsConfig()))(
        jnp.asarray(rng.integers(-6, 7, (64, 12, 16)), jnp.int8)
    )
    motion, noise = (jnp.asarray(rng.normal(size=(64, size)), jnp.float32) for size in (MOTION_SIZE, config.code_size))
    wanted = vae.in_waves(config, jnp.asarray(rng.random((64, 1, 12, 16)), jnp.float32))

    def gradient(name: str) -> np.ndarray:
        with in_precision(name):
            found = jax.jit(jax.grad(lambda p: vae.vae_loss(config, p, fields, motion, wanted, noise)[0]))(params)
        return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(found)])

    plain, rounded = gradient("float32"), gradient("bfloat16")
    off = np.linalg.norm(rounded - plain) / np.linalg.norm(plain)
    assert 1e-5 < off < 3e-2


@pytest.mark.parametrize("pairs", [1, 2])
def test_codes_and_gradients_are_those_of_programs_without_c(pairs: int) -> None:
    camera = CameraConfig(width=16, height=12)
    rng = np.random.default_rng(pairs)
    count = rng.poisson(0.7, (3, pairs, camera.height, camera.width)).astype(np.int32)
    polarity = np.where(count > 0, rng.choice([-1, 1], count.shape), 0).astype(np.int8)
    times = np.zeros(count.shape, np.float32)
    fields = event_field.EventField(*map(jnp.asarray, (count, polarity, times, times)), window_s=0.04)
    params, motion = shaken(fresh(CONFIG, camera, jax.random.key(0), layers=pairs)), jnp.stack([MOTION] * 3)

    def total(params: Any) -> jax.Array:
        mean, log_variance = vae.encode(CONFIG, params, fields, motion)
        return jnp.sum(jnp.sin(mean)) + jnp.sum(jnp.cos(log_variance))

    plain = jax.jit(jax.value_and_grad(total))(params)
    with own_program():
        program = jax.jit(jax.value_and_grad(lambda p: total(p)))
        assert (f"@{TARGET}" in program.lower(params).as_text()) is (shutil.which("cc") is not None)
        in_c = program(params)
    # Sums of up to 36 patches of 32 numbers, in another order.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), in_c, plain)
