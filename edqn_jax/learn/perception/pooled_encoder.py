"""The pooled set encoder (section 3.2): a sum over events of features of position and polarity, then a code.

An event is (x, y, t, p). The encoder's first layer is a sum over events, independent of their order,

    pooled = sum over events of f(x, y, p) outer phi(t),

with a learned feature f of position and polarity, and a sinusoidal phi of time. All events of a pixel between
two frames share x, y and p, so the sum over them reaches only phi, where it is a geometric series with a
closed form: the dense path costs the same for one event as for a thousand, and it is exact.

Field arrays are `[..., F, H, W]`: any leading dimensions are the batch, carried into a few large matmuls.
C is the number of temporal channels, 1 + 2 x `time_frequencies`.

Pictures `[..., P, H, W]` have P channels where a field has two, ON and OFF, and no time: they are pooled as the
sum over channels and pixels of f(x, y) x value, divided by the root of their number. They have C times the features, so
that the pooled vector, and all later layers, have the same size as for events.
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from edqn_jax.config import EncoderConfig
from edqn_jax.learn.perception.code import EVENT_CHANNELS, CodeHead
from edqn_jax.learn.perception.waves import channel_polarities, paired_relu_init, wave_table
from edqn_jax.sim.sensors.event_field import EventField
from edqn_jax.sine import sin_pi

POSITION_OCTAVES = 4
"""Sine-cosine pairs per image axis in the positional encoding; the finest period is a quarter image."""

POOL_SCALE = 1.0 / 8.0
"""Constant factor on the pooled sum: the root of some 64 events, so that the next layer sees unit scale."""


def temporal_sums(frequencies: int, field: EventField) -> list[Array | None]:
    """Returns the sums of phi(t) over each pixel's events in closed form: C arrays `[..., F, H, W]`.

    `phi(t) = [1, cos(2 pi k tau), sin(2 pi k tau), ...]` for k = 1 .. frequencies; tau is 0 at the window's start and 1
    at its end.

    None stands for a sum that is always zero: n events that divide the window evenly add up to
    the n-th roots of unity, which leave n where n divides the frequency, and nothing else.

    The geometric series of n phasors a step apart is Dirichlet's kernel, `sin(n x) / sin(x)`, times the
    middle phasor. Half turns are subtracted from x first: the kernel is then stable where sin(x) vanishes.

    Sums are in the field's units, see `event_field.in_units`.
    """
    sums = _sums_of_events(frequencies, field)
    if field.unit is None:
        return sums
    return [None if each is None else each * field.unit[..., None, None, None] for each in sums]


def _sums_of_events(frequencies: int, field: EventField) -> list[Array | None]:
    """Returns the sums of `temporal_sums` over events, each of which counts 1."""
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
        kernel = jnp.where(small, n, sin_pi(n * rest) / sin_pi(jnp.where(small, 0.5, rest)))
        middle = 2.0 * k * first + (n - 1.0) * (k * step + half_turns)
        sums += [kernel * sin_pi(middle + 0.5), kernel * sin_pi(middle)]
    return sums


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
        return jnp.stack([self.at(x, y, jnp.full(x.shape, p)) for p in channel_polarities(self.channels)])

    def at(self, x: Array, y: Array, p: Array) -> Array:
        place = positional_encoding(x.astype(jnp.float32), y.astype(jnp.float32), self.width, self.height)
        z = jnp.concatenate([place, p.astype(jnp.float32)[..., None]], axis=-1)
        for layer in self.layers[:-1]:
            z = nn.relu(layer(z))
        return self.layers[-1](z)


class PooledEncoder(nn.Module):
    """Set encoder. `dense` and `picture` have parameters of their own."""

    config: EncoderConfig
    height: int
    width: int
    channels: int = EVENT_CHANNELS
    timed: bool = True

    def setup(self) -> None:
        kind = {"table": PixelTable, "network": PixelNetwork}[self.config.pixel_features]
        temporal = 1 if self.timed else 1 + 2 * self.config.time_frequencies
        self.pixels = kind(temporal * self.config.features, self.height, self.width, self.channels)
        self.hidden = nn.Dense(self.config.hidden, kernel_init=paired_relu_init(inputs=False, outputs=True))
        self.code = CodeHead(self.config.code_size, mean_init=paired_relu_init(inputs=True, outputs=False))

    def __call__(self, sensed: EventField | Array, motion: Array) -> tuple[Array, Array]:
        """Returns mean and log-variance `[..., code_size]` of fields or pictures; the own motion is not used."""
        return self.dense(sensed) if isinstance(sensed, EventField) else self.picture(sensed)

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

    def picture(self, image: Array) -> tuple[Array, Array]:
        """Returns mean and log-variance `[..., code_size]` of pictures `[..., P, H, W]`."""
        everywhere = self.pixels.everywhere()
        flat = image.reshape(*image.shape[:-3], -1)
        return self._head(flat @ everywhere.reshape(flat.shape[-1], -1), flat.shape[-1] ** -0.5)

    def _head(self, pooled: Array, scale: float) -> tuple[Array, Array]:
        return self.code(nn.relu(self.hidden(pooled * scale)))
