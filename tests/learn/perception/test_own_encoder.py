"""An encoder of one's own inside the VAE: it learns, acts, and is refused where it does not fit."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import Array

from edqn_jax.config import ENCODERS, CameraConfig, Config, EncoderConfig
from edqn_jax.config.loading import make_config
from edqn_jax.errors import ConfigError
from edqn_jax.learn import samples
from edqn_jax.learn.perception import embedding, vae
from edqn_jax.learn.policy import fresh_policy
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sim.sensors.event_laws import random_field
from edqn_jax.sim.task.observation import MOTION_SIZE, Observation
from tests.support.registries import keep_as_they_are

SMALL = CameraConfig(width=6, height=4)


class Flat(nn.Module):
    """Two layers over times of events and own motion."""

    config: EncoderConfig
    height: int
    width: int
    extra: int = 0

    @nn.compact
    def __call__(self, field: EventField, motion: Array) -> tuple[Array, Array]:
        times = jnp.where(field.count > 0, field.t_first / field.window_s, 0.0)
        x = jnp.concatenate([times.reshape(*motion.shape[:-1], -1), motion], axis=-1)
        size = self.config.code_size + self.extra
        return nn.Dense(size, name="mean")(x), nn.Dense(size, name="log_variance")(x)


class Counting(Flat):
    """One that has batch statistics."""

    @nn.compact
    def __call__(self, field: EventField, motion: Array) -> tuple[Array, Array]:
        x = nn.Dense(self.config.code_size)(nn.BatchNorm(use_running_average=True)(motion))
        return x, x


class Forgetful(Flat):
    """One that takes one observation at a time."""

    @nn.compact
    def __call__(self, field: EventField, motion: Array) -> tuple[Array, Array]:
        x = nn.Dense(self.config.code_size)(motion).reshape(-1)[: self.config.code_size]
        return x, x


@pytest.fixture
def config(monkeypatch: pytest.MonkeyPatch) -> Config:
    keep_as_they_are(monkeypatch)
    ENCODERS.register("flat", Flat, "two layers")
    encoder = {"architecture": "flat", "code_size": 3, "decoder_hidden": (8,), "target": "sensed"}
    return make_config("paper", camera={"width": 6, "height": 4}, encoder=encoder, events={"law": "esim"})


@pytest.mark.whole
def test_it_learns_inside_of_the_vae_and_the_agent_sees_its_mean(config: Config) -> None:
    params = vae.init_vae(config.encoder, SMALL, jax.random.key(0))
    rng = np.random.default_rng(0)
    field = jax.tree.map(lambda *x: jnp.stack(x), *(random_field(config.events, 4, 6, rng) for _ in range(8)))
    motion = jnp.asarray(rng.normal(size=(8, MOTION_SIZE)), jnp.float32)
    wanted = vae.in_waves(config.encoder, vae.decoder_target(config.encoder, field))
    loss = jax.jit(
        jax.value_and_grad(lambda p: vae.vae_loss(config.encoder, p, field, motion, wanted, jnp.zeros((8, 3)))[0])
    )
    adam, trained = optax.adam(1e-2), params
    state, before = adam.init(params), loss(params)[0]
    for _ in range(30):
        change, state = adam.update(loss(trained)[1], state)
        trained = optax.apply_updates(trained, change)
    assert loss(trained)[0] < 0.8 * before
    moved = jax.tree.map(lambda a, b: bool(jnp.any(a != b)), trained, params)["encoder"]  # pyright: ignore
    assert jax.tree.all(moved)
    acting = embedding.inference_params(config, trained)
    seen = embedding.embed(config, acting, Observation(field, own=jnp.zeros((8, 1)), motion=motion))
    assert seen is not None
    layer = acting["encoder"]["mean"]
    times = jnp.where(field.count > 0, field.t_first / field.window_s, 0.0).reshape(8, -1)
    mean = jnp.concatenate([times, motion], axis=-1) @ layer["kernel"] + layer["bias"]
    np.testing.assert_allclose(seen, config.agent.code_scale * mean, rtol=1e-5, atol=1e-6)
    assert set(fresh_policy(config).encoder["encoder"]) == {"mean", "log_variance"}


def test_its_samples_keep_the_times_of_events(config: Config) -> None:
    field = random_field(config.events, 4, 6, np.random.default_rng(0))
    even = dataclasses.replace(field, divides_window=True)
    observation = Observation(even, own=jnp.zeros(1), motion=jnp.zeros(MOTION_SIZE))
    wanted = samples.target_of(config.encoder, observation, None)
    kept = samples.to_encoder_input(samples.samples_of(config.encoder, observation, wanted))
    assert isinstance(kept, EventField)
    np.testing.assert_array_equal(kept.t_first, field.t_first)


@pytest.mark.parametrize(
    ("encoder", "says"),
    [
        (lambda *made: Flat(*made, extra=1), r"each \[..., 3\]; of two observations it returns \(\(2, 4\), \(2, 4\)\)"),
        (Forgetful, r"each \[..., 3\]; of two observations it returns \(\(3,\), \(3,\)\)"),
        (Counting, "the encoder 'other' must have parameters alone, not batch_stats"),
    ],
)
def test_an_encoder_that_does_not_fit_is_refused(config: Config, encoder: Any, says: str) -> None:
    ENCODERS.register("other", encoder)
    with pytest.raises(ConfigError, match=says):
        vae.init_vae(dataclasses.replace(config.encoder, architecture="other"), SMALL, jax.random.key(0))


def test_an_encoder_that_nobody_registered_is_answered_with_the_nearest(config: Config) -> None:
    with pytest.raises(ConfigError, match="encoder.architecture: there is no encoder 'falt'; did you mean 'flat'?"):
        make_config("paper", encoder={"architecture": "falt"})
