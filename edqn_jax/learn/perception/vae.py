"""The event VAE (section 3.2): an encoder, a code, a decoder of ReLU layers (Eq. 6); also for pictures.

The encoder reads what the sensor shows and the drone's own motion; nothing else reaches the code. The decoder draws
`decoder_target`: what the sensor shows, which is the paper's VAE, or how near things are, a label that only training
needs.
"""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.nn.initializers import zeros

from edqn_jax.config import ENCODERS, CameraConfig, EncoderConfig
from edqn_jax.errors import ConfigError
from edqn_jax.learn.perception.code import EVENT_CHANNELS, Form, Params, kl_divergence
from edqn_jax.learn.perception.layers import Dense, init_params, matmul
from edqn_jax.learn.perception.pooled_encoder import PooledEncoder
from edqn_jax.learn.perception.waves import OUTPUT_SCALE, cosine_basis, paired_relu_init, wave_images
from edqn_jax.sim.sensors.event_field import EventField, in_units
from edqn_jax.sim.task.observation import MOTION_SIZE


@struct.dataclass
class Losses:
    """Terms of the VAE loss: sums over the image and over the code, averaged over the batch; scalars."""

    reconstruction: Array
    kl: Array


@struct.dataclass
class Target:
    """Target of the decoder, as coefficients of standing waves."""

    amplitudes: Array  # [..., channels, P, Q]
    beyond: Array  # [...] squared image left in all other waves


class Decoder(nn.Module):
    """Decodes a code `[..., code_size]` to the standing waves of the reconstruction, `[..., channels, P, Q]`."""

    config: EncoderConfig
    height: int
    width: int
    channels: int

    @nn.compact
    def __call__(self, code: Array) -> Array:
        z = code
        for layer, size in enumerate(self.config.decoder_hidden):
            z = nn.relu(Dense(size, kernel_init=paired_relu_init(inputs=layer > 0, outputs=True))(z))
        shape = (self.channels, *_output_size(self.config, self.height, self.width))
        kernel = self.param("kernel", wave_images(self.height, self.width), (z.shape[-1], *shape))
        bias = self.param("bias", zeros, shape)
        amplitudes = matmul(z, kernel.reshape(z.shape[-1], -1))
        return OUTPUT_SCALE * (amplitudes.reshape(*z.shape[:-1], *shape) + bias)


def _output_size(config: EncoderConfig, height: int, width: int) -> tuple[int, int]:
    """Returns P and Q, the number of standing waves down and across that the decoder outputs."""
    return tuple(max(1, round(config.decoder_bandwidth * size)) for size in (height, width))  # type: ignore


def target_channels(config: EncoderConfig, form: Form, layers: int = 1) -> int:
    """Returns the number of channels that the decoder draws, see `decoder_target`.

    Args:
        form: of what is encoded.
        layers: C of pictures.
    """
    shown = EVENT_CHANNELS if form is Form.EVENTS else layers
    return {"sensed": shown, "nearness": 1, "both": shown + 1}[config.target]


def needs_nearness(config: EncoderConfig) -> bool:
    """Returns whether the decoder must draw a label that the simulator renders for training."""
    return config.target != "sensed"


def decoder_target(config: EncoderConfig, sensed: EventField | Array, nearness: Array | None = None) -> Array:
    """Returns the target of the decoder, `[..., channels, H, W]`, blurred.

    Of `sensed`, log(1 + count) of ON and of OFF events, or the pictures; of `nearness`, the label; of `both`, all
    of these. Events have two channels because their number shows how near things are, and in a signed image the ON and
    OFF events of a textured wall cancel. The logarithm keeps one bright edge from dominating the loss; the blur (a
    binomial over 2 x `target_blur` + 1 pixels) makes an edge that is off by one pixel one small error, not two large
    ones.

    Args:
        sensed: field `[..., F, H, W]` or pictures `[..., C, H, W]`.
        nearness: `[..., H, W]` as the sensor `depth` shows it; needed unless the target is `sensed`.
    """
    image = _sharp_target(config, sensed, nearness)
    if config.target_blur == 0:
        return image
    height, width = image.shape[-2:]
    return jnp.asarray(_blur(height, config.target_blur)) @ (image @ jnp.asarray(_blur(width, config.target_blur).T))


def target_in_waves(config: EncoderConfig, sensed: EventField | Array, nearness: Array | None = None) -> Target:
    """Returns `decoder_target` in the standing waves that the decoder draws.

    Args:
        sensed: field `[..., F, H, W]` or pictures `[..., C, H, W]`.
        nearness: `[..., H, W]` without a unit; needed unless the target is `sensed`.
    """
    return in_waves(config, _sharp_target(config, sensed, nearness), config.target_blur)


def _sharp_target(config: EncoderConfig, sensed: EventField | Array, nearness: Array | None) -> Array:
    """Returns `decoder_target` before it is blurred."""
    channels = []
    if config.target != "nearness":
        channels.append(_input_channels(sensed))
    if needs_nearness(config):
        assert nearness is not None, "this target needs the label"
        channels.append(nearness[..., None, :, :])
    return jnp.concatenate(channels, axis=-3)


def _input_channels(sensed: EventField | Array) -> Array:
    """Returns what the sensor shows as channels `[..., C, H, W]`, summed over the window."""
    if not isinstance(sensed, EventField):
        return sensed
    counts = sensed.count if sensed.unit is None else in_units(sensed)
    on = jnp.sum(jnp.where(sensed.polarity > 0, counts, 0), axis=-3)
    off = jnp.sum(jnp.where(sensed.polarity < 0, counts, 0), axis=-3)
    return jnp.log1p(jnp.stack([on, off], axis=-3).astype(jnp.float32))


def _blur(size: int, times: int) -> np.ndarray:
    """Returns `[size, size]`: the kernel (1, 2, 1) / 4 as a matrix, edges repeated, applied `times` times."""
    once = 0.5 * np.eye(size) + 0.25 * (np.eye(size, k=1) + np.eye(size, k=-1))
    once[0, 0] += 0.25
    once[-1, -1] += 0.25
    return np.linalg.matrix_power(once, times).astype(np.float32)


def in_waves(config: EncoderConfig, image: Array, blur: int = 0) -> Target:
    """Returns a target `[..., channels, H, W]` in the standing waves that the decoder draws.

    Args:
        blur: how often the target is blurred first. (1, 2, 1) / 4, with edges repeated, leaves wave k of N pixels a
            wave, (1 + cos(pi k / N)) / 2 times as large.
    """
    height, width = image.shape[-2:]
    rows, columns = _output_size(config, height, width)
    down, across = (
        (cosine_basis(size, size) * (0.5 + 0.5 * np.cos(np.pi * np.arange(size) / size))[:, None] ** blur).astype(
            np.float32
        )
        for size in (height, width)
    )
    # Along rows first: XLA transposes what is multiplied from the left, and with it would compute the label in columns.
    waves = jnp.asarray(down) @ (image @ jnp.asarray(across.T))
    amplitudes = waves[..., :rows, :columns]
    # The waves are orthonormal, so squares add up over them as over pixels.
    axes = (-3, -2, -1)
    beyond = jnp.sum(jnp.square(waves), axis=axes) - jnp.sum(jnp.square(amplitudes), axis=axes)
    return Target(amplitudes, beyond)


def init_vae(
    config: EncoderConfig,
    camera: CameraConfig,
    key: Array,
    *,
    form: Form = Form.EVENTS,
    layers: int = 1,
    motion: int = MOTION_SIZE,
) -> Params:
    """Returns fresh parameters, `{"encoder": ..., "decoder": ...}`, for the camera's resolution.

    Args:
        form: of what is encoded.
        layers: frame pairs F of an event field, or C of pictures.
        motion: values of the own motion, see `sim.task.observation.motion_size`.

    Raises:
        ConfigError: if there is no such encoder, or it does not return a code, or has other variables.
    """
    key_encoder, key_decoder = jax.random.split(key)
    decoder = Decoder(config, camera.height, camera.width, target_channels(config, form, layers))
    when = jnp.zeros((layers, camera.height, camera.width))
    nothing = when.astype(jnp.int32)
    silent = EventField(nothing, nothing.astype(jnp.int8), when, when, window_s=1.0)
    blank = silent if form is Form.EVENTS else when
    encoder, name = _encoder(config, blank), f"the encoder '{config.architecture}'"
    params = init_params(encoder, name, key_encoder, sensed=blank, motion=jnp.zeros(motion))
    two = jax.tree.map(lambda x: jnp.stack([x, x]), (blank, jnp.zeros(motion)))
    shapes = jax.tree.map(jnp.shape, jax.eval_shape(encoder.apply, {"params": params}, *two))
    if shapes != 2 * ((2, config.code_size),):
        raise ConfigError(
            f"{name} must return mean and log-variance of the code, each [..., {config.code_size}]; of two "
            f"observations it returns {shapes}"
        )
    return {
        "encoder": params,
        "decoder": decoder.init(key_decoder, jnp.zeros(config.code_size))["params"],
    }


def _encoder(config: EncoderConfig, sensed: EventField | Array) -> nn.Module:
    """Returns the encoder of what is shown, or of shapes like it."""
    fields = isinstance(sensed, EventField)
    channels, height, width = (sensed.count if fields else sensed).shape[-3:]
    encoder = ENCODERS.get(config.architecture)(config, height, width)
    if isinstance(encoder, PooledEncoder) and not fields:
        return encoder.clone(channels=channels, timed=False)
    return encoder


def encode(config: EncoderConfig, params: Params, sensed: EventField | Array, motion: Array) -> tuple[Array, Array]:
    """Returns mean and log-variance, each `[..., code_size]`, of fields `[..., F, H, W]` or pictures `[..., C, H, W]`.

    The code that the agent sees is the mean.

    Args:
        motion: `[..., motion_size]` own motion, see `sim.task.observation.own_motion`.
    """
    encoder = _encoder(_with_features_of(config, params), sensed)
    return encoder.apply({"params": params["encoder"]}, sensed, motion)  # type: ignore


def freeze_params(
    config: EncoderConfig, camera: CameraConfig, params: Params, *, form: Form = Form.EVENTS, layers: int = 1
) -> Params:
    """Returns the parameters in the form that encodes fastest: the pooled encoder's pixel features as a table.

    A frozen encoder need not compute them again for each field or picture.

    Args:
        form: of what is encoded.
        layers: C of pictures.
    """
    if config.architecture != "pooled":
        return params
    timed = form is Form.EVENTS
    channels = EVENT_CHANNELS if timed else layers
    encoder = PooledEncoder(_with_features_of(config, params), camera.height, camera.width, channels, timed)
    table = encoder.apply({"params": params["encoder"]}, method=lambda encoder: encoder.pixels.everywhere())
    return {**params, "encoder": {**params["encoder"], "pixels": {"table": table}}}


def _with_features_of(config: EncoderConfig, params: Params) -> EncoderConfig:
    """Returns `config` with the kind of pixel features that these parameters have: a table in a frozen encoder."""
    tables = "table" in params["encoder"].get("pixels", {})
    return dataclasses.replace(config, pixel_features="table") if tables else config


def embed(config: EncoderConfig, params: Params, sensed: EventField | Array, motion: Array) -> Array:
    """Returns the agent's code, the mean `[..., code_size]`; arguments as `encode`."""
    return encode(config, params, sensed, motion)[0]


def decode(config: EncoderConfig, camera: CameraConfig, params: Params, code: Array) -> Array:
    """Decodes a code `[..., code_size]` into an estimate of `decoder_target`, `[..., channels, H, W]`."""
    found = _waves_of(config, camera.height, camera.width, params, code)
    rows, columns = found.shape[-2:]
    return jnp.asarray(cosine_basis(camera.height, rows).T) @ found @ jnp.asarray(cosine_basis(camera.width, columns))


def _waves_of(config: EncoderConfig, height: int, width: int, params: Params, code: Array) -> Array:
    """Returns the amplitudes `[..., channels, P, Q]` of the drawing's standing waves."""
    channels = params["decoder"]["bias"].shape[-3]
    return Decoder(config, height, width, channels).apply({"params": params["decoder"]}, code)  # type: ignore


def vae_loss(
    config: EncoderConfig,
    params: Params,
    sensed: EventField | Array,
    motion: Array,
    wanted: Target,
    noise: Array,
) -> tuple[Array, Losses]:
    """Returns the VAE loss, squared reconstruction error + `kl_weight` x KL, averaged over the batch, and its terms.

    The paper states it in section 3.2 without a number.

    Args:
        sensed: field `[..., F, H, W]` or pictures `[..., C, H, W]`.
        motion: `[..., motion_size]` own motion.
        wanted: what the decoder must draw, see `decoder_target` and `in_waves`.
        noise: `[..., code_size]` standard normal, which draws the codes (reparametrised).
    """
    mean, log_variance = encode(config, params, sensed, motion)
    code = mean + jnp.exp(0.5 * log_variance) * noise
    height, width = (sensed.count if isinstance(sensed, EventField) else sensed).shape[-2:]
    decoded = _waves_of(config, height, width, params, code)
    error = jnp.sum(jnp.square(decoded - wanted.amplitudes), axis=(-3, -2, -1)) + wanted.beyond
    losses = Losses(reconstruction=jnp.mean(error), kl=jnp.mean(kl_divergence(mean, log_variance)))
    return losses.reconstruction + config.kl_weight * losses.kl, losses
