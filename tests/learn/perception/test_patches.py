"""Patches of images: how they are cut, and that C cuts signed ones alike."""

from __future__ import annotations

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.learn.perception.patches import TARGET, patch_places, signed_patches, to_patches
from edqn_jax.native.own_programs import own_program


def test_patches_are_cut_row_by_row_and_padded_with_zeros() -> None:
    image = jnp.arange(1.0, 61.0).reshape(6, 10)
    cut = np.asarray(to_patches(image, 4))
    assert cut.shape == (6, 16)
    np.testing.assert_array_equal(cut[1].reshape(4, 4), image[:4, 4:8])
    np.testing.assert_array_equal(cut[5].reshape(4, 4)[:2, :2], image[4:, 8:])
    assert cut[5].reshape(4, 4)[2:].sum() == cut[5].reshape(4, 4)[:, 2:].sum() == 0.0
    np.testing.assert_allclose(patch_places(6, 10, 4)[:3], [[-0.6, -1 / 3], [0.2, -1 / 3], [1.0, -1 / 3]], atol=1e-6)


def test_patches_that_overlap_see_the_pixels_around_them_and_zeros_beyond_the_image() -> None:
    image = np.arange(1.0, 61.0).reshape(6, 10)
    cut = np.asarray(to_patches(jnp.stack([jnp.asarray(image), -jnp.asarray(image)]), 4, overlap=2))
    wide = np.pad(image, [(2, 4), (2, 4)])
    for number in range(6):
        row, column = divmod(number, 3)
        window = wide[4 * row : 4 * row + 8, 4 * column : 4 * column + 8].ravel()
        np.testing.assert_array_equal(cut[0, number], window)
        np.testing.assert_array_equal(cut[1, number], -window)


@pytest.mark.parametrize(
    ("size", "pixels", "overlap"), [((24, 32), 4, 0), ((6, 15), 3, 0), ((6, 10), 4, 0), ((8, 8), 4, 1)]
)
def test_signed_images_are_cut_into_what_is_above_zero_and_what_is_below(
    size: tuple[int, int], pixels: int, overlap: int
) -> None:
    rng = np.random.default_rng(3)
    images = rng.choice([-1.5, 0.0, 2.5], (2, 3, *size)).astype(np.float32) * rng.random((2, 3, *size), np.float32)
    with own_program():
        found = jax.jit(lambda x: signed_patches(x, pixels, overlap))(images)
    cut = np.asarray(to_patches(jnp.asarray(images), pixels, overlap))
    wanted = np.concatenate([np.where(cut > 0, cut, 0), np.where(cut < 0, -cut, 0)], axis=-1)
    np.testing.assert_array_equal(np.concatenate(found, axis=-1), wanted)
    with own_program():
        mapped = jax.vmap(lambda x: signed_patches(x, pixels, overlap), in_axes=1, out_axes=1)(images)
    np.testing.assert_array_equal(np.concatenate(mapped, axis=-1), wanted)


def test_where_there_is_a_compiler_c_cuts_what_it_can() -> None:
    def text(shape: tuple[int, ...], **options: int) -> str:
        with own_program():
            return jax.jit(lambda x: signed_patches(x, 4, **options)).lower(jnp.zeros(shape)).as_text()

    assert (TARGET in text((2, 24, 32))) is (shutil.which("cc") is not None)
    assert TARGET not in text((2, 6, 10)) and TARGET not in text((2, 8, 8), overlap=1)


def test_programs_of_others_can_be_exported_and_differentiated() -> None:
    image = jnp.linspace(-1.0, 1.0, 64).reshape(8, 8)
    assert TARGET not in jax.jit(lambda x: signed_patches(x, 4)).lower(image).as_text()
    jax.export.export(jax.jit(lambda x: signed_patches(x, 4)))(image)
    np.testing.assert_array_equal(jax.grad(lambda x: jnp.sum(signed_patches(x, 4)[0]))(image), image > 0)
