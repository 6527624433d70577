"""The event VAE (section 3.2): a sum-pooled set encoder, a code, a decoder of ReLU layers (Eq. 6); also for pictures.

An event is (x, y, t, p). The encoder's first layer is a sum over events, independent of their order,

    pooled = sum over events of f(x, y, p) outer phi(t),

with a learned feature f of position and polarity, and a sinusoidal phi of time. All events of a pixel between
two frames share x, y and p, so the sum over them reaches only phi, where it is a geometric series with a
closed form: the dense path costs the same for one event as for a thousand, and it is exact.

Field arrays are `[..., F, H, W]`: any leading dimensions are the batch, carried into a few large matmuls.
C is the number of temporal channels, 1 + 2 x `time_frequencies`.

A picture `[..., H, W]` has one channel where a field has two, ON and OFF, and no time: it is pooled as
sum over pixels of f(x, y) x value, divided by the root of their number. It has C times the features, so that the
pooled vector, and all later layers, have the same size as for events.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.nn.initializers import constant, lecun_normal, zeros

from edqn_jax.config import CameraConfig, EncoderConfig
from edqn_jax.sim.events import EventField
from edqn_jax.sim.sensor import Form

Params = Any
"""Nested dictionaries of arrays."""

POSITION_OCTAVES = 4
"""Sine-cosine pairs per image axis in the positional encoding; the finest period is a quarter image."""

WAVES = 48
"""Number of standing waves of the image that the first and last layer are initialised with."""

OUTPUT_SCALE = 2.0
"""Constant factor on the decoder's amplitudes; with it the VAE learns as fast as one that decodes single pixels."""

POOL_SCALE = 1.0 / 8.0
"""Constant factor on the pooled sum: the root of some 64 events, so that the next layer sees unit scale."""

EVENT_CHANNELS, PICTURE_CHANNELS = 2, 1
"""ON and OFF events; brightness or nearness."""

CHANNELS = {Form.EVENTS: EVENT_CHANNELS, Form.PICTURE: PICTURE_CHANNELS}
"""Channels of the forms that the VAE embeds."""

MAX_LOG_VARIANCE = 6.0
"""Bound of the log-variance's magnitude: its exponential cannot overflow."""

MAX_MEAN = 1e3
"""Bound of a code value's magnitude: its square cannot overflow."""


@struct.dataclass
class Losses:
    """Terms of the VAE loss: sums over the image and over the code, averaged over the batch; scalars."""

    reconstruction: Array
    kl: Array


def temporal_encoding(frequencies: int, tau: Array) -> Array:
    """Returns `phi(t) = [1, cos(2 pi k tau), sin(2 pi k tau), ...]` for k = 1 .. frequencies: `[...]` to `[..., C]`.

    `tau` is the time normalised to the window: 0 at its start, 1 at its end.
    """
    channels = [jnp.ones_like(tau)]
    for k in range(1, frequencies + 1):
        channels += [jnp.cos(2.0 * jnp.pi * k * tau), jnp.sin(2.0 * jnp.pi * k * tau)]
    return jnp.stack(channels, axis=-1)


def temporal_sums(frequencies: int, field: EventField) -> list[Array | None]:
    """Returns the sums of `temporal_encoding` over each pixel's events in closed form: C arrays `[..., F, H, W]`.

    None stands for a sum that is always zero: n events that divide the window evenly add up to
    the n-th roots of unity, which leave n where n divides the frequency, and nothing else.

    The geometric series of n phasors a step apart is Dirichlet's kernel, `sin(n x) / sin(x)`, times the
    middle phasor. Half turns are subtracted from x first: the kernel is then stable where sin(x) vanishes.
    """
    n = field.count.astype(jnp.float32)
    if field.divides_window:
        sums: list[Array | None] = [n]
        for k in range(1, frequencies + 1):
            divides = sum((n == d) for d in range(1, k + 1) if k % d == 0)
            sums += [n * divides, None]
        return sums
    first, step = field.t_first / field.window_s, field.t_step / field.window_s
    sums = [n]
    for k in range(1, frequencies + 1):
        half_turns = jnp.round(k * step)
        rest = k * step - half_turns
        small = jnp.abs(rest) < 1e-6
        kernel = jnp.where(small, n, _sin_pi(n * rest) / _sin_pi(jnp.where(small, 0.5, rest)))
        middle = 2.0 * k * first + (n - 1.0) * (k * step + half_turns)
        sums += [kernel * _sin_pi(middle + 0.5), kernel * _sin_pi(middle)]
    return sums


def _sin_pi(z: Array) -> Array:
    """Returns `sin(pi z)` to 1e-7, exact at integers: a polynomial, three times as fast as XLA's sine on a CPU."""
    turns = jnp.round(z)
    x = jnp.pi * (z - turns)
    y = x * x
    series = 1.0 + y * (-1 / 6 + y * (1 / 120 + y * (-1 / 5040 + y * (1 / 362880 - y / 39916800))))
    return x * series * (1.0 - 2.0 * (turns - 2.0 * jnp.floor(0.5 * turns)))


def positional_encoding(x: Array, y: Array, width: int, height: int) -> Array:
    """Returns sines and cosines of a pixel's position, `[...]` to `[..., 4 * POSITION_OCTAVES + 2]`."""
    u, v = (x + 0.5) / width * 2.0 - 1.0, (y + 0.5) / height * 2.0 - 1.0
    channels = [u, v]
    for octave in range(POSITION_OCTAVES):
        for place in (u, v):
            angle = jnp.pi * 2.0**octave * 0.5 * place
            channels += [jnp.cos(angle), jnp.sin(angle)]
    return jnp.stack(channels, axis=-1)


class PixelTable(nn.Module):
    """f(x, y, p) as a free table over pixels and polarities."""

    features: int
    height: int
    width: int
    channels: int = EVENT_CHANNELS

    def setup(self) -> None:
        shape = (self.channels, self.height * self.width, self.features)
        self.table = self.param("table", wave_table(self.height, self.width), shape)

    def everywhere(self) -> Array:
        """Returns f of every pixel, `[channels, H * W, features]`, ON first."""
        return self.table

    def at(self, x: Array, y: Array, p: Array) -> Array:
        """Returns f, `[..., features]`, at columns x, rows y, polarities p."""
        return self.table[(p < 0).astype(jnp.int32), y * self.width + x]


class PixelNetwork(nn.Module):
    """f(x, y, p) as a ReLU network on the positional encoding and the polarity."""

    features: int
    height: int
    width: int
    channels: int = EVENT_CHANNELS

    def setup(self) -> None:
        self.layers = [nn.Dense(64), nn.Dense(64), nn.Dense(self.features)]

    def everywhere(self) -> Array:
        y, x = jnp.divmod(jnp.arange(self.height * self.width), self.width)
        return jnp.stack([self.at(x, y, jnp.full_like(x, p)) for p in (1, -1)[: self.channels]])

    def at(self, x: Array, y: Array, p: Array) -> Array:
        place = positional_encoding(x.astype(jnp.float32), y.astype(jnp.float32), self.width, self.height)
        z = jnp.concatenate([place, p.astype(jnp.float32)[..., None]], axis=-1)
        for layer in self.layers[:-1]:
            z = nn.relu(layer(z))
        return self.layers[-1](z)


def cosines(size: int, count: int) -> np.ndarray:
    """Returns the `count` lowest standing waves of `size` pixels as orthonormal rows: `[count, size]` (the DCT-II)."""
    place = (np.arange(size) + 0.5) / size
    rows = np.cos(np.pi * np.arange(count)[:, None] * place) * np.sqrt(2.0 / size)
    rows[0] /= np.sqrt(2.0)
    return rows.astype(np.float32)


def lowest_waves(height: int, width: int, rows: int, columns: int) -> np.ndarray:
    """Returns which of the first `rows` x `columns` standing waves are among the `WAVES` lowest: `[rows, columns]`."""
    frequency = np.hypot(np.arange(rows)[:, None] / height, np.arange(columns) / width)
    return np.argsort(np.argsort(frequency, axis=None, kind="stable")).reshape(rows, columns) < WAVES


def waves(height: int, width: int) -> Array:
    """Returns the `WAVES` lowest standing waves of the image (products of cosines), rms 1: `[WAVES, H, W]`."""
    down, across = np.nonzero(lowest_waves(height, width, height, width))
    image = cosines(height, height)[down][:, :, None] * cosines(width, width)[across][:, None, :]
    return jnp.asarray(image * np.sqrt(height * width), jnp.float32)


def wave_table(height: int, width: int) -> Callable[..., Array]:
    """Returns the initialiser of `PixelTable`: mixtures of waves, half of each odd in the polarity, half even."""

    def init(key: Array, shape: tuple[int, ...]) -> Array:
        key_odd, key_even = jax.random.split(key)
        basis = waves(height, width).reshape(-1, height * width).T
        mix = lecun_normal()
        odd = basis @ mix(key_odd, (basis.shape[1], shape[-1]))
        even = basis @ mix(key_even, (basis.shape[1], shape[-1]))
        return jnp.stack([even + odd, even - odd][: shape[0]])

    return init


def mirrored(*, inputs: bool, outputs: bool) -> Callable[..., Array]:
    """Returns an initialiser of ReLU layers that makes the untrained network linear.

    Units come in pairs of opposite sign and are read in pairs of opposite sign: relu(a) - relu(-a) = a. The positions
    of events then affect the code, and the code affects the image, from the first update on.
    """

    def init(key: Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
        rows = -(-shape[0] // 2) if inputs else shape[0]
        columns = -(-shape[1] // 2) if outputs else shape[1]
        kernel = lecun_normal()(key, (rows, columns), dtype)
        if outputs:
            kernel = jnp.concatenate([kernel, -kernel], axis=1)
        if inputs:
            kernel = jnp.concatenate([kernel, -kernel], axis=0)
        return kernel[: shape[0], : shape[1]]

    return init


def wave_images(height: int, width: int) -> Callable[..., Array]:
    """Returns the initialiser of the decoder's last layer, `[hidden, channels, P, Q]`: small lowest waves, mirrored.

    Event images are smooth on average, white noise is not: initialised with white noise the decoder outputs a blank
    image for thousands of updates, with waves it does not. Part of each wave is common to ON and OFF, part of
    opposite sign.
    """

    def init(key: Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
        size, channels, rows, columns = shape
        lowest = lowest_waves(height, width, rows, columns)
        key_even, key_odd = jax.random.split(key)
        even, odd = (
            0.0075
            * np.sqrt(height * width)
            / OUTPUT_SCALE
            * lecun_normal()(k, (-(-size // 2), lowest.size), dtype).reshape(-1, rows, columns)
            * jnp.asarray(lowest * np.sqrt(lowest.size / lowest.sum()), dtype)
            for k in (key_even, key_odd)
        )
        kernel = jnp.stack([even + odd, even - odd][:channels], axis=1)
        return jnp.concatenate([kernel, -kernel])[:size]

    return init


class Encoder(nn.Module):
    """Sum-pooled set encoder. `dense` and `sparse` share their parameters and agree; `picture` has its own."""

    config: EncoderConfig
    height: int
    width: int
    channels: int = EVENT_CHANNELS

    def setup(self) -> None:
        kind = {"table": PixelTable, "network": PixelNetwork}[self.config.pixel_features]
        temporal = 1 + 2 * self.config.time_frequencies if self.channels == PICTURE_CHANNELS else 1
        self.pixels = kind(temporal * self.config.features, self.height, self.width, self.channels)
        size = self.config.code_size
        self.hidden = nn.Dense(self.config.hidden, kernel_init=mirrored(inputs=False, outputs=True))
        self.mean = nn.Dense(size, kernel_init=mirrored(inputs=True, outputs=False))
        # Nearly noiseless codes at first; the KL term increases the variance.
        self.log_variance = nn.Dense(size, kernel_init=zeros, bias_init=constant(-4.0))

    def dense(self, field: EventField) -> tuple[Array, Array]:
        """Returns mean and log-variance `[..., code_size]` of fields `[..., F, H, W]`."""
        on, off = self.pixels.everywhere()
        batch = field.count.shape[:-3]
        pooled = []
        for phi in temporal_sums(self.config.time_frequencies, field):
            if phi is None:
                pooled.append(jnp.zeros((*batch, on.shape[-1])))
                continue
            phi_on = jnp.sum(jnp.where(field.polarity > 0, phi, 0.0), axis=-3).reshape(*batch, -1)
            phi_off = jnp.sum(jnp.where(field.polarity < 0, phi, 0.0), axis=-3).reshape(*batch, -1)
            pooled.append(phi_on @ on + phi_off @ off)
        return self._head(jnp.concatenate(pooled, axis=-1), POOL_SCALE)

    def sparse(self, x: Array, y: Array, tau: Array, p: Array) -> tuple[Array, Array]:
        """Returns mean and log-variance of event lists, each `[..., N]`; entries with p = 0 are no events."""
        place = self.pixels.at(x, y, p) * (p != 0)[..., None]
        phi = temporal_encoding(self.config.time_frequencies, tau)
        pooled = jnp.einsum("...nf,...nc->...cf", place, phi)
        return self._head(pooled.reshape(*pooled.shape[:-2], -1), POOL_SCALE)

    def picture(self, image: Array) -> tuple[Array, Array]:
        """Returns mean and log-variance `[..., code_size]` of pictures `[..., H, W]`."""
        (everywhere,) = self.pixels.everywhere()
        flat = image.reshape(*image.shape[:-2], -1)
        return self._head(flat @ everywhere, flat.shape[-1] ** -0.5)

    def _head(self, pooled: Array, scale: float) -> tuple[Array, Array]:
        z = nn.relu(self.hidden(pooled * scale))
        mean = jnp.clip(self.mean(z), -MAX_MEAN, MAX_MEAN)
        return mean, jnp.clip(self.log_variance(z), -MAX_LOG_VARIANCE, MAX_LOG_VARIANCE)


class Decoder(nn.Module):
    """Decodes a code `[..., code_size]` to the standing waves of the reconstruction, `[..., channels, P, Q]`."""

    config: EncoderConfig
    height: int
    width: int
    channels: int = EVENT_CHANNELS

    @nn.compact
    def __call__(self, code: Array) -> Array:
        z = code
        for layer, size in enumerate(self.config.decoder_hidden):
            z = nn.relu(nn.Dense(size, kernel_init=mirrored(inputs=layer > 0, outputs=True))(z))
        shape = (self.channels, *_drawn(self.config, self.height, self.width))
        kernel = self.param("kernel", wave_images(self.height, self.width), (z.shape[-1], *shape))
        bias = self.param("bias", zeros, shape)
        amplitudes = z @ kernel.reshape(z.shape[-1], -1)
        return OUTPUT_SCALE * (amplitudes.reshape(*z.shape[:-1], *shape) + bias)


def _drawn(config: EncoderConfig, height: int, width: int) -> tuple[int, int]:
    """Returns P and Q, the number of standing waves down and across that the decoder outputs."""
    return tuple(max(1, round(config.decoder_bandwidth * size)) for size in (height, width))  # type: ignore


def target(config: EncoderConfig, sensed: EventField | Array) -> Array:
    """Returns what the decoder must reconstruct, `[..., channels, H, W]`, blurred: log(1 + count) of ON and of OFF
    events, or the picture itself.

    Events have two channels because their number shows how near things are, and in a signed image the ON and OFF
    events of a textured wall cancel. The logarithm keeps one bright edge from dominating the loss; the blur (a
    binomial over 2 x `target_blur` + 1 pixels) makes an edge that is off by one pixel one small error, not two
    large ones.
    """
    if isinstance(sensed, EventField):
        on = jnp.sum(jnp.where(sensed.polarity > 0, sensed.count, 0), axis=-3)
        off = jnp.sum(jnp.where(sensed.polarity < 0, sensed.count, 0), axis=-3)
        image = jnp.log1p(jnp.stack([on, off], axis=-3).astype(jnp.float32))
    else:
        image = sensed[..., None, :, :]
    if config.target_blur == 0:
        return image
    height, width = image.shape[-2:]
    return jnp.asarray(_blur(height, config.target_blur)) @ image @ jnp.asarray(_blur(width, config.target_blur).T)


def _blur(size: int, times: int) -> np.ndarray:
    """Returns `[size, size]`: the kernel (1, 2, 1) / 4 as a matrix, edges repeated, applied `times` times."""
    once = 0.5 * np.eye(size) + 0.25 * (np.eye(size, k=1) + np.eye(size, k=-1))
    once[0, 0] += 0.25
    once[-1, -1] += 0.25
    return np.linalg.matrix_power(once, times).astype(np.float32)


def init_encoder(config: EncoderConfig, camera: CameraConfig, key: Array, *, form: Form = Form.EVENTS) -> Params:
    """Returns fresh parameters, `{"encoder": ..., "decoder": ...}`, for the camera's resolution.

    Args:
        form: of what is encoded; a key of `CHANNELS`.
    """
    key_encoder, key_decoder = jax.random.split(key)
    channels = CHANNELS[form]
    encoder = Encoder(config, camera.height, camera.width, channels)
    decoder = Decoder(config, camera.height, camera.width, channels)
    when = jnp.zeros((1, camera.height, camera.width))
    nothing = when.astype(jnp.int32)
    silent = EventField(nothing, nothing.astype(jnp.int8), when, when, window_s=1.0)
    blank, method = (silent, Encoder.dense) if form is Form.EVENTS else (when[0], Encoder.picture)
    return {
        "encoder": encoder.init(key_encoder, blank, method=method)["params"],
        "decoder": decoder.init(key_decoder, jnp.zeros(config.code_size))["params"],
    }


def encode(config: EncoderConfig, params: Params, sensed: EventField | Array) -> tuple[Array, Array]:
    """Returns mean and log-variance, each `[..., code_size]`, of fields `[..., F, H, W]` or pictures `[..., H, W]`.

    The code that the agent sees is the mean.
    """
    fields = isinstance(sensed, EventField)
    height, width = (sensed.count if fields else sensed).shape[-2:]
    encoder = Encoder(_of_kind(config, params), height, width, EVENT_CHANNELS if fields else PICTURE_CHANNELS)
    method = Encoder.dense if fields else Encoder.picture
    return encoder.apply({"params": params["encoder"]}, sensed, method=method)  # type: ignore


def encode_events(
    config: EncoderConfig, params: Params, camera: CameraConfig, x: Array, y: Array, tau: Array, p: Array
) -> tuple[Array, Array]:
    """Returns the same as `encode` from a list of events, `[..., N]` each: column, row, time in the window, polarity.

    `tau` is 0 at the window's start and 1 at its end; p = 0 marks an empty entry.
    """
    encoder = Encoder(_of_kind(config, params), camera.height, camera.width)
    return encoder.apply({"params": params["encoder"]}, x, y, tau, p, method=Encoder.sparse)  # type: ignore


def tabulated(config: EncoderConfig, camera: CameraConfig, params: Params) -> Params:
    """Returns the same encoder with its pixel features tabulated for the camera's resolution.

    A frozen encoder need not compute them again for each field or picture.
    """
    channels = params["decoder"]["bias"].shape[-3]
    encoder = Encoder(_of_kind(config, params), camera.height, camera.width, channels)
    table = encoder.apply({"params": params["encoder"]}, method=lambda encoder: encoder.pixels.everywhere())
    return {**params, "encoder": {**params["encoder"], "pixels": {"table": table}}}


def _of_kind(config: EncoderConfig, params: Params) -> EncoderConfig:
    """Returns `config` with the kind of pixel features that these parameters have: a table in a frozen encoder."""
    tables = "table" in params["encoder"]["pixels"]
    return dataclasses.replace(config, pixel_features="table") if tables else config


def embed(config: EncoderConfig, params: Params, sensed: EventField | Array) -> Array:
    """Returns the agent's code of fields `[..., F, H, W]` or pictures `[..., H, W]`: the mean, `[..., code_size]`."""
    return encode(config, params, sensed)[0]


def decode(config: EncoderConfig, camera: CameraConfig, params: Params, code: Array) -> Array:
    """Returns the reconstruction of `target`, `[..., channels, H, W]`, from a code `[..., code_size]`."""
    found = _waves_of(config, camera.height, camera.width, params, code)
    rows, columns = found.shape[-2:]
    return jnp.asarray(cosines(camera.height, rows).T) @ found @ jnp.asarray(cosines(camera.width, columns))


def _waves_of(config: EncoderConfig, height: int, width: int, params: Params, code: Array) -> Array:
    """Returns the amplitudes `[..., channels, P, Q]` of the reconstruction's standing waves."""
    channels = params["decoder"]["bias"].shape[-3]
    return Decoder(config, height, width, channels).apply({"params": params["decoder"]}, code)  # type: ignore


def kl_divergence(mean: Array, log_variance: Array) -> Array:
    """Returns KL(N(mean, variance) || N(0, 1)), summed over the code: `[..., code_size]` to `[...]`."""
    return 0.5 * jnp.sum(jnp.square(mean) + jnp.exp(log_variance) - 1.0 - log_variance, axis=-1)


def vae_loss(config: EncoderConfig, params: Params, sensed: EventField | Array, key: Array) -> tuple[Array, Losses]:
    """Returns the VAE loss, squared reconstruction error + `kl_weight` x KL, averaged over the batch, and its terms.

    The paper states it in section 3.2 without a number.

    Args:
        sensed: field `[..., F, H, W]` or picture `[..., H, W]`.
        key: draws the codes (reparametrised).
    """
    mean, log_variance = encode(config, params, sensed)
    code = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape)
    image = target(config, sensed)
    height, width = image.shape[-2:]
    drawn = _waves_of(config, height, width, params, code)
    # The waves are orthonormal, so squared errors add up over them as over pixels; the error in waves
    # beyond the decoder's is a constant.
    rows, columns = drawn.shape[-2:]
    wanted = jnp.asarray(cosines(height, rows)) @ image @ jnp.asarray(cosines(width, columns).T)
    beyond = jnp.sum(jnp.square(image), axis=(-3, -2, -1)) - jnp.sum(jnp.square(wanted), axis=(-3, -2, -1))
    error = jnp.sum(jnp.square(drawn - wanted), axis=(-3, -2, -1)) + beyond
    losses = Losses(reconstruction=jnp.mean(error), kl=jnp.mean(kl_divergence(mean, log_variance)))
    return losses.reconstruction + config.kl_weight * losses.kl, losses
