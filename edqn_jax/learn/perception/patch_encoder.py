"""The patch encoder: events are summed per pixel, pixels are read together in patches, patches are joined to a code.

An event tells distance only together with the motion that made it, and only beside its neighbours. So the layers
before the join are shared by all patches, and each sees the patch's place in the image and the drone's own motion.

N is the number of patches, K the number of pixels in one.
"""

from __future__ import annotations

from functools import partial

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.config import EncoderConfig
from edqn_jax.learn.perception.code import CodeHead
from edqn_jax.learn.perception.layers import Dense, add_shared
from edqn_jax.sim.sensors.event_field import EventField, in_units


def log_counts(field: EventField) -> list[Array]:
    """Returns log(1 + count) of ON and of OFF events of each pixel, of each pair of frames: 2 F arrays [..., H, W].

    With noise, a pixel's ON and OFF events between two frames stand in rows of their own.
    """
    level = jnp.log(1.0 + in_units(field))
    if field.with_noise:
        pairs = jnp.split(level, 2, axis=-3)
    else:
        # A pixel's events between two frames have one polarity, so one logarithm serves both channels.
        pairs = [jnp.where(sign, level, 0.0) for sign in (field.polarity > 0, field.polarity < 0)]
    return [pair[..., row, :, :] for row in range(pairs[0].shape[-3]) for pair in pairs]


def to_patches(image: Array, pixels: int, overlap: int = 0) -> Array:
    """Cuts images `[..., H, W]` into square patches of `pixels` x `pixels`: `[..., N, K]`, row by row.

    Images whose sides are no multiples of `pixels` are padded with zeros at the right and at the bottom; patches that
    reach beyond the image see zeros there.

    Args:
        overlap: by how many pixels each side of a patch reaches into the patches around it; K is then
            (pixels + 2 overlap)^2.
    """
    *batch, height, width = image.shape
    rows, columns = -(-height // pixels), -(-width // pixels)
    if overlap:
        flat = jnp.pad(image.reshape(*batch, height * width), [(0, 0)] * len(batch) + [(0, 1)])  # the last one is 0
        return jnp.take(flat, _pixels_of_patches(height, width, pixels, overlap), axis=-1)
    missing = rows * pixels - height, columns * pixels - width
    if any(missing):
        image = jnp.pad(image, [(0, 0)] * len(batch) + [(0, size) for size in missing])
    cut = image.reshape(*batch, rows, pixels, columns, pixels).swapaxes(-3, -2)
    return cut.reshape(*batch, rows * columns, pixels * pixels)


def _pixels_of_patches(height: int, width: int, pixels: int, overlap: int) -> np.ndarray:
    """Returns the number of each pixel of each patch in the image, row by row, `[N, K]`; `height * width` outside."""
    rows, columns = -(-height // pixels), -(-width // pixels)
    window = np.arange(-overlap, pixels + overlap)
    down = (np.arange(rows) * pixels)[:, None, None, None] + window[:, None]
    across = (np.arange(columns) * pixels)[:, None, None] + window
    inside = (down >= 0) & (down < height) & (across >= 0) & (across < width)
    return np.where(inside, down * width + across, height * width).reshape(rows * columns, -1)


def patch_places(height: int, width: int, pixels: int) -> np.ndarray:
    """Returns the centres of the patches, `[N, 2]`: across and down, each from -1 to 1 over the image."""
    rows, columns = -(-height // pixels), -(-width // pixels)
    down, across = np.divmod(np.arange(rows * columns), columns)
    middle = np.stack([(across + 0.5) * pixels / width, (down + 0.5) * pixels / height], axis=-1)
    return (2.0 * middle - 1.0).astype(np.float32)


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
        images = log_counts(sensed) if isinstance(sensed, EventField) else list(jnp.moveaxis(sensed, -3, 0))
        first, *later = self.config.patch_layers
        # One product for each channel: joined to one array first, they take twice as long on a CPU.
        cut = partial(to_patches, pixels=self.config.patch_pixels, overlap=self.config.patch_overlap)
        products = [
            Dense(first, use_bias=number == 0, name=f"channel_{number}")(cut(image))
            for number, image in enumerate(images)
        ]
        z = sum(products[1:], products[0])
        # A layer over patch, place and motion together; what all patches or all fields share is computed once.
        place = patch_places(self.height, self.width, self.config.patch_pixels)
        z = add_shared(z, Dense(first, use_bias=False, name="place")(jnp.asarray(place)))
        z += Dense(first, use_bias=False, name="motion")(motion)[..., None, :]
        z = nn.relu(z)
        for number, size in enumerate(later, start=1):
            z = nn.relu(Dense(size, name=f"patch_{number}")(z))
        z = jnp.concatenate([z.reshape(*z.shape[:-2], -1), motion], axis=-1)
        for number, size in enumerate(self.config.joint_layers):
            z = nn.relu(Dense(size, name=f"joint_{number}")(z))
        return CodeHead(self.config.code_size, name="code")(z)
