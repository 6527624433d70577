"""The patch encoder: events are summed per pixel, pixels are read together in patches, patches are joined to a code.

An event tells distance only together with the motion that made it, and only beside its neighbours. So the layers
before the join are shared by all patches, and each sees the patch's place in the image and the drone's own motion.

N is the number of patches, K the number of pixels in one (`patches.py` cuts them).
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from edqn_jax.config import EncoderConfig
from edqn_jax.learn.perception.code import CodeHead
from edqn_jax.learn.perception.layers import Dense, Weights, add_shared, add_to_each, matmul
from edqn_jax.learn.perception.patches import patch_places, signed_patches, to_patches
from edqn_jax.sim.sensors.event_field import EventField, in_units


def log_counts(field: EventField, pixels: int, overlap: int = 0) -> list[Array]:
    """Returns log(1 + count) of ON and of OFF events, of each pair of frames, in patches of several arrays.

    Joined, they are `[..., N, 2 F K]`; each is of one or of both, see `signed_patches`.
    With noise, a pixel's ON and OFF events between two frames stand in rows of their own.

    Args:
        pixels, overlap: as of `to_patches`.
    """
    level = jnp.log(1.0 + in_units(field))
    if field.with_noise:
        pairs = jnp.split(level, 2, axis=-3)
        rows = range(pairs[0].shape[-3])
        return [to_patches(pair[..., row, :, :], pixels, overlap) for row in rows for pair in pairs]
    # A pixel's events between two frames have one polarity, so one signed image serves both channels.
    signed = level * field.polarity
    rows = range(signed.shape[-3])
    return [part for row in rows for part in signed_patches(signed[..., row, :, :], pixels, overlap)]


class PatchEncoder(nn.Module):
    """Layers shared by all patches, layers over all patches joined, and the code."""

    config: EncoderConfig
    height: int
    width: int

    @nn.compact
    def __call__(self, sensed: EventField | Array, motion: Array) -> tuple[Array, Array]:
        """Returns mean and log-variance `[..., code_size]` of fields `[..., F, H, W]` or pictures `[..., C, H, W]`.

        Args:
            motion: `[..., motion_size]` own motion, see `sim.task.observation.own_motion`.
        """
        size = self.config.patch_pixels, self.config.patch_overlap
        if isinstance(sensed, EventField):
            channels = log_counts(sensed, *size)
        else:
            channels = [to_patches(image, *size) for image in jnp.moveaxis(sensed, -3, 0)]
        first, *later = self.config.patch_layers
        # One product for each array of channels: to join arrays here takes XLA longer than a product fewer saves.
        pixels = (self.config.patch_pixels + 2 * self.config.patch_overlap) ** 2
        weights = [
            Weights(first, use_bias=number == 0, name=f"channel_{number}")(pixels)
            for number in range(sum(channel.shape[-1] for channel in channels) // pixels)
        ]
        products, kernels = [], [kernel for kernel, *_ in weights]
        for channel in channels:
            count = channel.shape[-1] // pixels
            products.append(matmul(channel, jnp.concatenate(kernels[:count]) if count > 1 else kernels[0]))
            kernels = kernels[count:]
        z = add_shared(sum(products[1:], products[0]), weights[0][1])
        # A layer over patch, place and motion together; what all patches or all fields share is computed once.
        place = patch_places(self.height, self.width, self.config.patch_pixels)
        z = add_shared(z, Dense(first, use_bias=False, name="place")(jnp.asarray(place)))
        z = nn.relu(add_to_each(z, Dense(first, use_bias=False, name="motion")(motion)))
        for number, size in enumerate(later, start=1):
            z = nn.relu(Dense(size, name=f"patch_{number}")(z))
        z = jnp.concatenate([z.reshape(*z.shape[:-2], -1), motion], axis=-1)
        for number, size in enumerate(self.config.joint_layers):
            z = nn.relu(Dense(size, name=f"joint_{number}")(z))
        return CodeHead(self.config.code_size, name="code")(z)
