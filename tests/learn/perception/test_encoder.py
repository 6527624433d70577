"""The event VAE with the pooled encoder: the dense factorisation, its losses, and that it learns."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from edqn_jax.config import CameraConfig, EncoderConfig, EventsConfig
from edqn_jax.learn.perception import pooled_encoder, vae
from edqn_jax.learn.perception.code import Form, kl_divergence
from edqn_jax.sim.sensors import event_field
from edqn_jax.sim.task.observation import MOTION_SIZE
from tests.oracles import event_fields, pooled_encoder_plain
from tests.support.marks import in_whole
from tests.support.moving_boxes import fields

CAMERA = CameraConfig()
SMALL = CameraConfig(width=6, height=4)
CONFIG = EncoderConfig(architecture="pooled", target="sensed")
STILL = jnp.zeros(MOTION_SIZE)
WINDOWS = 4096
UPDATES = 300


fresh = jax.jit(vae.init_vae, static_argnums=(0, 1))


@partial(jax.jit, static_argnums=0)
def embed(config, params, sensed):
    return vae.embed(config, params, sensed, STILL)


def encode(config, params, sensed):
    return vae.encode(config, params, sensed, STILL)


def loss_of(config, params, sensed, key):
    """The loss of fields whose own motion does not matter."""
    wanted = vae.in_waves(config, vae.decoder_target(config, sensed))
    noise = jax.random.normal(key, (*wanted.beyond.shape, config.code_size))
    return vae.vae_loss(config, params, sensed, STILL, wanted, noise)


def ragged_field(seed: int, frame_pairs: int = 3) -> event_field.EventField:
    """Random counts, polarities and times: more varied than any law would make them."""
    rng = np.random.default_rng(seed)
    shape = (frame_pairs, SMALL.height, SMALL.width)
    count = rng.poisson(2.0, shape).astype(np.int32)
    count[0, 0, :4] = [1, 2, 30, 0]
    first = rng.uniform(0.0, 0.01, shape).astype(np.float32)
    step = (rng.uniform(0.0, 1.0, shape) * 0.02 / np.maximum(count, 1)).astype(np.float32)
    step[0, 0, :4] = 0.0  # all events at one instant: the geometric series degenerates
    step[0, 1, 0], count[0, 1, 0] = 0.02, 2  # half a turn of k = 1, a whole turn of k = 2
    polarity = np.where(count > 0, rng.choice([-1, 1], shape), 0).astype(np.int8)
    return jax.tree.map(jnp.asarray, event_field.EventField(count, polarity, first, step, 0.04))  # type: ignore


def event_list(field: event_field.EventField) -> tuple[jax.Array, ...]:
    """Columns, rows, normalised times and polarities of all events, one by one, two empty places appended."""
    field, found = jax.tree.map(np.asarray, field), []
    for row, y, x in np.argwhere(np.asarray(field.count) > 0):
        for k in range(int(field.count[row, y, x])):
            t = float(field.t_first[row, y, x]) + k * float(field.t_step[row, y, x])
            found.append((x, y, t / field.window_s, int(field.polarity[row, y, x])))
    x, y, tau, p = (np.array(column) for column in zip(*found, (3, 1, 0.5, 0), (0, 0, 0.0, 0), strict=True))
    return jnp.asarray(x), jnp.asarray(y), jnp.asarray(tau, jnp.float32), jnp.asarray(p)


def even_field() -> event_field.EventField:
    """As the default law makes them of one pair of frames: counts 0 to 5, either polarity."""
    rng = np.random.default_rng(4)
    counts = rng.integers(-5, 6, (SMALL.height, SMALL.width)).astype(np.int8)
    counts[0] = [0, 1, -1, 2, -2, 3]
    return event_fields.field_of_counts(EventsConfig(), jnp.asarray(counts))


@pytest.mark.parametrize(
    ("field", "kind"),
    [
        pytest.param(ragged_field(1), "network", id="ragged-network"),
        pytest.param(even_field(), "table", id="even-table", marks=pytest.mark.whole),
        pytest.param(ragged_field(1), "table", id="ragged-table", marks=pytest.mark.whole),
        pytest.param(even_field(), "network", id="even-network", marks=pytest.mark.whole),
    ],
)
@pytest.mark.slow
def test_dense_encoder_pools_single_events(kind, field):
    config = dataclasses.replace(CONFIG, pixel_features=kind, time_frequencies=2)
    config = dataclasses.replace(config, features=8, hidden=16, code_size=5)
    params = fresh(config, SMALL, jax.random.key(0))
    x, y, tau, p = event_list(field)
    weights = jax.random.normal(jax.random.key(1), (2, 5))

    def score(encode, params):
        mean, log_variance = encode(params)
        return jnp.sum(weights[0] * mean + weights[1] * log_variance), (mean, log_variance)

    def dense(params):
        return encode(config, params, field)

    def sparse(params):
        return pooled_encoder_plain.encode_events(config, params, SMALL, x, y, tau, p)

    graded = partial(jax.value_and_grad, has_aux=True)
    (_, codes), gradient = jax.jit(graded(partial(score, dense)))(params)
    (_, plain_codes), plain_gradient = jax.jit(graded(partial(score, sparse)))(params)
    # Sums of some 150 float32 terms of order 1, then two layers.
    for a, b in zip(codes, plain_codes, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)
    for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(plain_gradient), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3)


@pytest.mark.whole
@pytest.mark.parametrize("form", [Form.EVENTS, Form.PICTURE], ids=["events", "pictures"])
@pytest.mark.parametrize("kind", ["table", *in_whole("network")])
@pytest.mark.slow
def test_pixel_features_written_out_give_the_same_codes(kind, form):
    config = dataclasses.replace(CONFIG, pixel_features=kind, features=8, hidden=16, code_size=5)
    params = vae.init_vae(config, SMALL, jax.random.key(0), form=form)
    table = vae.freeze_params(config, SMALL, params, form=form)
    assert "table" in table["encoder"]["pixels"] and table["decoder"] is params["decoder"]
    field, picture = ragged_field(6), jax.random.normal(jax.random.key(1), (1, SMALL.height, SMALL.width))
    sensed = field if form is Form.EVENTS else picture
    # One and the same product of the same numbers, but for what is fused into it.
    for one, two in zip(encode(config, params, sensed), encode(config, table, sensed), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-5)
    if form is Form.EVENTS:
        events = event_list(field)
        codes = (pooled_encoder_plain.encode_events(config, p, SMALL, *events)[0] for p in (params, table))
        np.testing.assert_allclose(*codes, rtol=1e-5, atol=1e-5)
    again = vae.freeze_params(config, SMALL, table, form=form)
    assert jax.tree.all(jax.tree.map(np.array_equal, table, again))


def test_sums_of_events_that_divide_the_window_are_those_of_any_events():
    field = even_field()
    assert field.divides_window
    known = pooled_encoder.temporal_sums(3, field)
    sums = pooled_encoder.temporal_sums(3, dataclasses.replace(field, divides_window=False))
    assert [k for k, phi in enumerate(known) if phi is None] == [2, 4, 6]
    for phi, general in zip(known, sums, strict=True):
        assert general is not None
        np.testing.assert_allclose(0.0 if phi is None else phi, general, atol=1e-5)  # float32 of five terms


@pytest.mark.slow
def test_the_encoder_is_blind_to_the_order_of_events():
    config = dataclasses.replace(CONFIG, features=8, hidden=16, code_size=5)
    params = fresh(config, SMALL, jax.random.key(0))
    columns = event_list(ragged_field(2))
    shuffle = np.random.default_rng(0).permutation(len(columns[0]))
    mean, _ = pooled_encoder_plain.encode_events(config, params, SMALL, *columns)
    again, _ = pooled_encoder_plain.encode_events(config, params, SMALL, *(column[shuffle] for column in columns))
    np.testing.assert_allclose(mean, again, rtol=1e-4, atol=1e-4)  # float32 sums in another order


@pytest.mark.slow
def test_time_in_the_window_changes_the_code():
    params = fresh(CONFIG, SMALL, jax.random.key(0))
    field = ragged_field(3)
    late = dataclasses.replace(field, t_first=field.t_first + 0.01)
    assert np.abs(embed(CONFIG, params, field) - embed(CONFIG, params, late)).max() > 0.01


@pytest.mark.slow
def test_a_batch_is_encoded_as_its_fields_are_one_by_one():
    params = fresh(CONFIG, SMALL, jax.random.key(0))
    batch = jax.tree.map(lambda *x: jnp.stack(x), *[ragged_field(k) for k in range(4)])
    whole, mapped = embed(CONFIG, params, batch), jax.vmap(partial(embed, CONFIG, params))(batch)
    single = [embed(CONFIG, params, ragged_field(k)) for k in range(4)]
    assert whole.shape == (4, CONFIG.code_size)
    np.testing.assert_allclose(whole, mapped, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(whole, jnp.stack(single), rtol=1e-4, atol=1e-4)
    assert vae.decode(CONFIG, SMALL, params, whole).shape == (4, 2, SMALL.height, SMALL.width)


@pytest.mark.slow
def test_the_untrained_decoder_is_linear_in_the_code():
    params = fresh(CONFIG, CAMERA, jax.random.key(0))
    a, b = jax.random.normal(jax.random.key(1), (2, CONFIG.code_size))
    both = vae.decode(CONFIG, CAMERA, params, a + b)
    apart = vae.decode(CONFIG, CAMERA, params, a) + vae.decode(CONFIG, CAMERA, params, b)
    np.testing.assert_allclose(both, apart, atol=1e-5)  # float32 sums of order 1
    assert np.abs(both).max() > 0.003


def test_kl_is_the_textbook_value_and_zero_for_the_prior():
    assert float(kl_divergence(jnp.zeros(4), jnp.zeros(4))) == 0.0
    # One dimension, N(1, 2) from N(0, 1): (1 + 2 - 1 - log 2) / 2.
    value = kl_divergence(jnp.ones(1), jnp.log(2.0) * jnp.ones(1))
    np.testing.assert_allclose(value, 0.5 * (2.0 - np.log(2.0)), rtol=1e-6)


LOSS_AND_GRADIENT = jax.jit(jax.value_and_grad(loss_of, argnums=1, has_aux=True), static_argnums=0)


@pytest.mark.parametrize("scale", [1e6, -1e6])
@pytest.mark.slow
def test_losses_and_gradients_stay_finite_under_huge_activations(scale):
    params = fresh(CONFIG, SMALL, jax.random.key(0))
    params["encoder"] = jax.tree.map(lambda x: x * scale, params["encoder"])
    params["encoder"]["code"]["log_variance"]["bias"] += scale
    batch = jax.tree.map(lambda x: x[None], ragged_field(1))
    (loss, losses), gradient = LOSS_AND_GRADIENT(CONFIG, params, batch, jax.random.key(0))
    assert np.isfinite(loss) and np.isfinite(losses.kl) and np.isfinite(losses.reconstruction)
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_the_loss_is_reconstruction_plus_weighted_kl():
    config = dataclasses.replace(CONFIG, kl_weight=0.3)
    params = fresh(config, SMALL, jax.random.key(0))
    batch = jax.tree.map(lambda x: x[None], ragged_field(1))
    (loss, losses), _ = LOSS_AND_GRADIENT(config, params, batch, jax.random.key(0))
    np.testing.assert_allclose(loss, losses.reconstruction + 0.3 * losses.kl, rtol=1e-6)
    assert float(losses.kl) > 0.0 and float(losses.reconstruction) > 0.0


@pytest.mark.parametrize("bandwidth", [0.5, *in_whole(1.0)])
@pytest.mark.slow
def test_the_error_over_waves_is_the_error_over_pixels(bandwidth):
    config = dataclasses.replace(CONFIG, decoder_bandwidth=bandwidth)
    params = fresh(config, SMALL, jax.random.key(0))
    field = ragged_field(1)
    _, losses = jax.jit(loss_of, static_argnums=0)(config, params, field, jax.random.key(2))
    mean, log_variance = jax.jit(encode, static_argnums=0)(config, params, field)
    noise = jnp.exp(0.5 * log_variance) * jax.random.normal(jax.random.key(2), mean.shape)
    image = jax.jit(vae.decode, static_argnums=(0, 1))(config, SMALL, params, mean + noise)
    expected = jnp.sum(jnp.square(image - vae.decoder_target(config, field)))
    np.testing.assert_allclose(losses.reconstruction, expected, rtol=1e-5)


def test_the_target_keeps_polarities_apart_and_compresses_counts():
    image = np.zeros((1, SMALL.height, SMALL.width), np.int8)
    image[0, 2, 3], image[0, 0, 0] = 7, -1
    field = event_fields.field_of_counts(EventsConfig(), jnp.asarray(image[0]))
    sharp = vae.decoder_target(dataclasses.replace(CONFIG, target_blur=0), field)
    expected = np.log1p(np.stack([np.maximum(image[0], 0), np.maximum(-image[0], 0)]).astype(np.float32))
    np.testing.assert_allclose(sharp, expected, rtol=1e-6)
    blurred = vae.decoder_target(dataclasses.replace(CONFIG, target_blur=1), field)
    np.testing.assert_allclose(blurred.sum(), sharp.sum(), rtol=1e-5)
    np.testing.assert_allclose(blurred[0, 2, 3], sharp[0, 2, 3] / 4.0, rtol=1e-5)


@pytest.mark.parametrize("times", [0, 1, 3])
def test_a_blurred_target_in_waves_is_that_of_the_blurred_image(times: int) -> None:
    config = dataclasses.replace(CONFIG, target_blur=times)
    image = jax.random.uniform(jax.random.key(0), (2, 1, 12, 16))
    found, wanted = vae.target_in_waves(config, image), vae.in_waves(config, vae.decoder_target(config, image))
    np.testing.assert_allclose(found.amplitudes, wanted.amplitudes, atol=1e-5)  # amplitudes of up to 10
    # A difference of sums of up to 100.
    np.testing.assert_allclose(found.beyond, wanted.beyond, atol=1e-4)
    squares = jnp.sum(jnp.square(found.amplitudes), axis=(1, 2, 3)) + found.beyond
    np.testing.assert_allclose(squares, jnp.sum(vae.decoder_target(config, image) ** 2, axis=(1, 2, 3)), rtol=1e-5)


@pytest.fixture(scope="module")
def trained():
    """Parameters before and after training on moving boxes, and unseen windows."""
    make = jax.jit(partial(fields, CAMERA, EventsConfig(), number=WINDOWS))
    seen, unseen = make(jax.random.key(1)), make(jax.random.key(2))
    optimiser = optax.adam(CONFIG.learning_rate)

    def update(carry, key):
        params, state = carry
        key_batch, key_code = jax.random.split(key)
        index = jax.random.randint(key_batch, (256,), 0, WINDOWS)
        batch = jax.tree.map(lambda x: x[index], seen)
        gradient, losses = jax.grad(lambda p: loss_of(CONFIG, p, batch, key_code), has_aux=True)(params)
        change, state = optimiser.update(gradient, state)
        return (optax.apply_updates(params, change), state), losses

    @jax.jit
    def train(params):
        return jax.lax.scan(update, (params, optimiser.init(params)), jax.random.split(jax.random.key(3), UPDATES))

    before = fresh(CONFIG, CAMERA, jax.random.key(0))
    (after, _), losses = train(before)
    return before, after, losses, unseen


@jax.jit
def error_of(params, field):
    image = vae.decode(CONFIG, CAMERA, params, embed(CONFIG, params, field))
    return jnp.mean(jnp.sum(jnp.square(image - vae.decoder_target(CONFIG, field)), axis=(-3, -2, -1)))


@pytest.mark.whole
@pytest.mark.slow
def test_training_reconstructs_unseen_windows_better_than_any_constant(trained):
    before, after, losses, unseen = trained
    target = vae.decoder_target(CONFIG, unseen)
    constant = float(jnp.mean(jnp.sum(jnp.square(target - target.mean(0)), axis=(-3, -2, -1))))
    assert float(error_of(after, unseen)) < 0.8 * constant
    assert float(error_of(after, unseen)) < 0.8 * float(error_of(before, unseen))
    assert np.all(np.isfinite(losses.kl)) and float(losses.kl[-1]) > 1.0


@pytest.mark.whole
@pytest.mark.slow
def test_codes_tell_boxes_on_the_left_from_boxes_on_the_right(trained):
    _, after, _, _ = trained
    make = jax.jit(partial(fields, CAMERA, EventsConfig(), number=1024), static_argnames="side")
    sides = [embed(CONFIG, after, make(jax.random.key(4), side=side)) for side in (-1.0, 1.0)]
    code = np.concatenate(sides).astype(np.float64)
    label = np.repeat([-1.0, 1.0], 1024)
    # An object's sign depends on its shade, so its side is in the code's energy, not in its mean: a linear
    # read-out of the products of code values.
    pairs = np.triu_indices(code.shape[1])
    inputs = np.c_[np.ones(len(code)), code, (code[:, :, None] * code[:, None, :])[:, pairs[0], pairs[1]]]
    train, test = np.arange(2048) % 4 != 0, np.arange(2048) % 4 == 0
    inputs = inputs / inputs[train].std(0).clip(1e-6)
    gram = inputs[train].T @ inputs[train] + 10.0 * np.eye(inputs.shape[1])
    readout = np.linalg.solve(gram, inputs[train].T @ label[train])
    assert np.mean(np.sign(inputs[test] @ readout) == label[test]) > 0.8  # 0.89 measured, 0.5 is chance
