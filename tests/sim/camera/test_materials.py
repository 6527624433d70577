"""Pictures of patterns for MuJoCo, without drawing; `tests/opengl` draws them."""

# pyright: reportArgumentType=false

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from edqn_jax.config import CameraConfig
from edqn_jax.errors import ConfigError
from edqn_jax.sim.camera.painting import materials
from edqn_jax.sim.camera.painting.materials import painted_spec, write_painted
from edqn_jax.sim.scene.mjcf import load_scene, mjcf_of
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.scene.surface import Surface
from tests.support.drawn_scenes import GROUND, box, pillar, scene_of

K = np.array([0.31, -0.23, 0.17])
"""Cycles a metre of the one wave."""


@pytest.fixture(autouse=True)
def small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(materials, "TILE_TEXELS", 256)


def waving(shape: object, contrast: float = 0.5) -> object:
    numbers = np.zeros(22, np.float32)
    numbers[[0, 1, 2]] = 1, contrast, 1.0
    numbers[6:10] = *K, 0.1
    return dataclasses.replace(shape, surface=Surface(numbers, ("waves",)))  # type: ignore[type-var]


@pytest.fixture
def world() -> Scene:
    return scene_of(waving(GROUND), waving(box(20, 30, 5, 2, 3, 5, 0.4)), waving(pillar(40, 30, 5, 2, 5), 0.0))


def expected(albedo: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Colours [..., 3] at offsets [..., 3] from the centre of a shape, without averages."""
    phase = offset @ K + 0.1
    f = phase - np.round(phase)
    return albedo * (1 + 0.5 * f * (8 - 16 * np.abs(f)))[..., None]


def picture(model: mujoco.MjModel, name: str) -> np.ndarray:
    texture = model.texture(name).id
    wide, high = model.tex_width[texture], model.tex_height[texture]
    begin = model.tex_adr[texture]
    return model.tex_data[begin : begin + wide * high * 3].reshape(-1, wide, wide, 3) / 255


def test_a_texel_of_a_box_shows_the_pattern_at_its_place(world: Scene) -> None:
    faces = picture(painted_spec(CameraConfig(), world).compile(), "box1")
    n = faces.shape[1]
    albedo = np.asarray(world.boxes.albedo[0])
    turn = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]])
    at = (2 * np.arange(n) + 1) / n - 1
    s, t = np.meshgrid(at, at)
    one = np.ones_like(s)
    # OpenGL's specification, "Cube Map Texture Selection": s and t of each face by the direction's components.
    directions = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    for face, direction in zip(faces, directions, strict=True):
        offset = (np.stack(direction, axis=-1) * [2, 3, 5]) @ turn.T
        assert np.abs(face - expected(albedo, offset)).max() < 0.01
        assert np.ptp(face) > 0.1


def test_a_texel_of_the_ground_shows_the_pattern_at_its_place(world: Scene) -> None:
    model = painted_spec(CameraConfig(), world).compile()
    tile, material = picture(model, "plane1")[0], model.material("plane1")
    side = 2 / material.texrepeat[0]
    lower, upper = np.asarray(world.volume)
    assert side > np.max(upper[:2] - lower[:2])
    x, y = np.meshgrid(np.arange(4, 60, 7.0), np.arange(4, 60, 7.0))
    # u = 1/2 + x / side and v = 1/2 - y / side: `tests/opengl` holds MuJoCo to it.
    texel = [np.floor(256 * ((0.5 + sign * w / side) % 1)).astype(int) for sign, w in ((1, x), (-1, y))]
    middle = [side * ((texel[0] + 0.5) / 256 - 0.5), side * (0.5 - (texel[1] + 0.5) / 256)]
    middle = [m + side * np.round((w - m) / side) for m, w in zip(middle, (x, y), strict=True)]
    wanted = expected(np.asarray(GROUND.albedo), np.stack([*middle, 0 * x], axis=-1))
    assert np.abs(tile[texel[1], texel[0]] - wanted).max() < 0.01


def test_what_has_no_pattern_keeps_its_colour_and_bodies_are_the_same(world: Scene) -> None:
    painted, plain = painted_spec(CameraConfig(), world).compile(), mujoco.MjModel.from_xml_string(mjcf_of(world))
    assert [painted.material(i).name for i in range(painted.nmat)] == ["box1", "plane1"]
    for name in ("geom_type", "geom_size", "geom_pos", "geom_quat"):
        np.testing.assert_array_equal(getattr(painted, name), getattr(plain, name))
    np.testing.assert_array_equal(painted.geom("cylinder1").rgba, plain.geom("cylinder1").rgba)
    # A world without light of its own has that of the camera's options.
    np.testing.assert_allclose(painted.vis.headlight.ambient, CameraConfig().ambient, atol=1e-6)


def test_shapes_without_surfaces_carry_the_plaid_where_there_is_one() -> None:
    world = scene_of(GROUND, box(20, 30, 5, 2, 3, 5))
    assert painted_spec(CameraConfig(), world).compile().nmat == 2
    assert painted_spec(CameraConfig(texture_contrast=0.0), world).compile().nmat == 0


def test_a_written_world_is_as_mujoco_has_it_in_memory(world: Scene, tmp_path: Path) -> None:
    write_painted(CameraConfig(), world, tmp_path / "w.xml")
    assert sorted(file.name for file in tmp_path.rglob("*.png")) == ["box1.png", "plane1.png"]
    read, painted = (
        mujoco.MjModel.from_xml_path(str(tmp_path / "w.xml")),
        painted_spec(CameraConfig(), world).compile(),
    )
    for name in ("box1", "plane1"):
        np.testing.assert_array_equal(picture(read, name), picture(painted, name))
        mine, its = (model.material(name) for model in (read, painted))
        np.testing.assert_allclose(mine.texrepeat, its.texrepeat, rtol=1e-6)
        assert mine.texuniform == its.texuniform and np.all(read.geom(name).rgba == 1)
    # Of textures nothing is read but that they are there.
    read = load_scene(tmp_path / "w.xml").shapes()
    assert all(read[kind].position.shape == shapes.position.shape for kind, shapes in world.shapes().items())


def test_a_file_that_cannot_be_written_is_one_sentence(world: Scene, tmp_path: Path) -> None:
    (tmp_path / "w_textures").write_text("")
    with pytest.raises(ConfigError, match="w_textures' cannot be written"):
        write_painted(CameraConfig(), world, tmp_path / "w.xml")
