"""Patterns and light of a world survive being written."""

# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from edqn_jax.config import SurfaceConfig
from edqn_jax.sim.scene.mjcf import SceneError, load_scene, mjcf_of, named_shapes, write_scene
from edqn_jax.sim.scene.scene import Scene, take_scene
from edqn_jax.sim.scene.surface import CONTRAST, SURFACE_NUMBERS
from edqn_jax.sim.worlds.families import random_pool, world_keys
from edqn_jax.sim.worlds.looks import with_looks

KEYS = world_keys("test", 1)


@pytest.fixture(scope="module")
def drawn() -> Scene:
    pool = with_looks(random_pool("rooms", KEYS), KEYS, SurfaceConfig(pattern="drawn"))
    return jax.tree.map(np.asarray, take_scene(pool, 0))


def test_a_drawn_world_is_read_with_the_looks_that_it_was_written_with(drawn: Scene, tmp_path: Path) -> None:
    write_scene(drawn, tmp_path / "drawn.xml")
    read = load_scene(tmp_path / "drawn.xml")
    for ours, its in zip(jax.tree.leaves(drawn.daylight), jax.tree.leaves(read.daylight), strict=True):
        np.testing.assert_array_equal(ours, its)
    pairs = list(zip(named_shapes(drawn), named_shapes(read), strict=True))
    for (name, ours), (same, its) in pairs:
        assert name == same
        np.testing.assert_array_equal(ours.albedo, its.albedo)
        if ours.surface is not None:
            np.testing.assert_array_equal(ours.surface.numbers, its.surface.numbers)
    assert sum(shape.surface.numbers[CONTRAST] > 0 for (_, shape), _ in pairs) > 3


def test_mujoco_has_its_sun_its_ambient_light_and_its_sky(drawn: Scene) -> None:
    model, light = mujoco.MjModel.from_xml_string(mjcf_of(drawn)), drawn.daylight
    np.testing.assert_allclose(model.light_dir[0], -light.sun, atol=1e-6)
    np.testing.assert_allclose(model.light_diffuse[0], 1 - light.ambient, atol=1e-6)
    np.testing.assert_allclose(model.vis.headlight.ambient, light.ambient, atol=1e-6)
    assert not model.light_castshadow[0] and not np.any(model.vis.headlight.diffuse)
    sky = model.tex_data[model.tex_adr[0] :].reshape(-1, 3)
    assert np.abs(sky / 255 - light.sky).max() < 0.005


def test_a_world_of_one_plaid_says_nothing_of_looks() -> None:
    assert "numeric" not in mjcf_of(take_scene(random_pool("sparse", KEYS), 0))


GEOMS = '<geom name="it" type="box" size="1 1 1"/><geom name="other" type="sphere" pos="5 0 0" size="1"/>'
STRIPES = "3 0.5 1 0 0 0.5 " + "0 " * (SURFACE_NUMBERS - 6)


def write(file: Path, custom: str) -> Path:
    file.write_text(f"<mujoco><worldbody>{GEOMS}</worldbody><custom>{custom}</custom></mujoco>")
    return file


def test_a_geom_of_which_nothing_is_said_is_blank_beside_others(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path / "w.xml", f'<numeric name="surface:it" data="{STRIPES}"/>'))
    assert scene.boxes.surface.patterns == scene.spheres.surface.patterns == ("checks",)
    assert scene.boxes.surface.numbers[0, CONTRAST] == 0.5 and not np.any(scene.spheres.surface.numbers)
    assert scene.daylight is None


@pytest.mark.parametrize(
    "name, data, said",
    [
        ("surface:door", STRIPES, "names no solid geom 'door'"),
        ("surface:it", "3 0.5", f"must have {SURFACE_NUMBERS} finite numbers"),
        ("surface:it", STRIPES.replace("3 ", "8 ", 1), "must begin with a pattern, 0 to 7"),
        ("surface:it", STRIPES.replace("0.5", "1.5", 1), "a contrast from 0 to 1"),
        ("daylight", "0 0 1 0.5 1 1", "'daylight' must have a direction of length 1"),
        ("daylight", "0 0 2 0.5 1 1 1", "'daylight' must have a direction of length 1"),
        ("daylight", "0 0 1 1.5 1 1 1", "four numbers from 0 to 1"),
    ],
)
def test_numbers_that_are_no_look_are_refused_in_one_sentence(tmp_path: Path, name: str, data: str, said: str) -> None:
    with pytest.raises(SceneError, match=said) as caught:
        load_scene(write(tmp_path / "w.xml", f'<numeric name="{name}" data="{data}"/>'))
    assert "\n" not in str(caught.value)


def test_a_world_without_daylight_of_its_own_may_have_patterns(drawn: Scene, tmp_path: Path) -> None:
    write_scene(dataclasses.replace(drawn, daylight=None), tmp_path / "w.xml")
    read = load_scene(tmp_path / "w.xml")
    assert read.daylight is None and read.boxes.surface is not None
