"""Images cut into square patches. N is the number of patches, K the number of pixels in one."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from edqn_jax.native.build import ensure_registered
from edqn_jax.native.own_programs import is_own_program

SOURCE = Path(__file__).with_suffix(".c")

TARGET = "edqn_signed_patches"


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


def signed_patches(image: Array, pixels: int, overlap: int = 0) -> list[Array]:
    """Returns what is above 0 in images `[..., H, W]`, and how far the rest is below, each cut as by `to_patches`.

    They are two arrays `[..., N, K]`, or one `[..., N, 2 K]`: in the package's own programs `patches.c` cuts whole
    patches at once, on CPUs with a C compiler. What becomes of NaN is left open.
    """
    *batch, height, width = image.shape
    whole = not (overlap or height % pixels or width % pixels)
    in_c = is_own_program() and whole and image.dtype == jnp.float32 and jax.default_backend() == "cpu"
    if not in_c or not is_available():
        cut = to_patches(image, pixels, overlap)
        size = jnp.abs(cut)
        return [jnp.where(cut > 0, size, 0.0), jnp.where(cut < 0, size, 0.0)]
    count = (height // pixels) * (width // pixels)
    shape = jax.ShapeDtypeStruct((*batch, count, 2 * pixels * pixels), jnp.float32)
    return [jax.ffi.ffi_call(TARGET, shape, vmap_method="broadcast_all")(image, jnp.int32(pixels))]


def is_available() -> bool:
    """Returns whether the library is loaded and registered, which the first call does."""
    return ensure_registered(SOURCE, (TARGET,))


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
