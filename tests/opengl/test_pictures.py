"""MuJoCo's pictures of our worlds. `.ci/run` runs this where there is EGL: `MUJOCO_GL=egl pytest -n0 tests/opengl`."""

# pyright: reportArgumentType=false
# Single shapes are written with plain numbers here.

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import mujoco
import numpy as np
import pytest

import edqn_jax
from edqn_jax.config import CameraConfig
from edqn_jax.interop.outer import pictures
from edqn_jax.interop.outer.poses import camera_rotation
from edqn_jax.sim.camera import camera
from edqn_jax.sim.camera.painting.materials import painted_spec
from edqn_jax.sim.environment import Environment
from edqn_jax.sim.scene.mjcf import mjcf_of
from edqn_jax.sim.scene.scene import Capsules, Spheres, TiltedBoxes, TiltedCylinders
from tests.support.drawn_scenes import box, pillar, rotation_of, scene_of

import transfer  # isort: skip

pytestmark = pytest.mark.filterwarnings("ignore")  # rotorpy, jax2onnx and what they import


@functools.cache
def medium() -> Environment:
    return edqn_jax.make("medium", edqn_jax.load_policy("pretrained").config, worlds=2, split="test")


def mujoco_luma(look: str, seed: int = 3) -> np.ndarray:
    spec, scene = pictures.spec_of(medium(), 0, look, seed), medium().scene(0)
    return _luma(spec, medium().config.camera, np.asarray(scene.start, np.float64), _towards_goal())


def _towards_goal() -> np.ndarray:
    way = np.asarray(medium().scene(0).goal) - np.asarray(medium().scene(0).start)
    half = np.arctan2(way[1], way[0]) / 2
    return camera_rotation(np.array([np.cos(half), 0.0, 0.0, np.sin(half)]), "level")


def test_mujoco_draws_the_same_view():
    """Edges of the plain picture lie where true depth jumps or the sky begins."""
    state, _ = medium().reset(0, 0)
    depth = np.asarray(medium().depth(state))
    shown = mujoco_luma("plain")
    far = 1 / (1 + np.where(np.isfinite(depth), depth, 1e3))
    jumps = np.abs(np.diff(far, axis=1)) > 0.05
    steps = np.abs(np.diff(np.log(shown + 1e-3), axis=1)) > 0.1
    near_a_step = steps | np.roll(steps, 1, axis=1) | np.roll(steps, -1, axis=1)
    assert jumps.sum() > 20
    # A jump is missed where two shapes happen to have one brightness.
    assert near_a_step[jumps].mean() > 0.85
    mirrored = near_a_step[:, ::-1]
    assert near_a_step[jumps].mean() > mirrored[jumps].mean() + 0.2


def test_looks_differ_and_no_site_is_seen():
    plain, textured, shadows = (mujoco_luma(look) for look in ("plain", "textured", "shadows"))
    assert np.abs(textured - plain).mean() > 0.02
    assert np.abs(shadows - plain).max() > 0.02
    # The camera stands within the site `start`, which would be all that it sees.
    assert np.ptp(plain) > 0.2
    assert np.array_equal(mujoco_luma("textured"), textured)
    assert np.abs(mujoco_luma("textured", seed=4) - textured).mean() > 0.02


def alike(one: np.ndarray, other: np.ndarray) -> float:
    """Returns the correlation of two pictures' log brightness."""
    return float(np.corrcoef(np.log(one.ravel() + 1e-3), np.log(other.ravel() + 1e-3))[0, 1])


def test_a_world_has_its_own_look_in_mujocos_picture(tmp_path: Path):
    """The ground shows the pattern where ours has it, also from a file."""
    config = medium().config
    config = dataclasses.replace(config, surface=dataclasses.replace(config.surface, pattern="checks"))
    world = edqn_jax.make("medium", config, split="test")
    where = np.asarray(world.scene(0).start, np.float64), _towards_goal()
    ours = pictures.own_pictures(config, world, 0)(*where)
    world.write_painted(tmp_path / "w.xml")
    specs = [pictures.spec_of(world, 0, look, 0) for look in ("own", "plain")]
    specs.append(mujoco.MjSpec.from_file(str(tmp_path / "w.xml")))
    shown = [_luma(spec, config.camera, *where) for spec in specs]
    # Brightness itself is the same: 0.004 is one step of 8 bits.
    assert alike(ours, shown[0]) > 0.995 and np.abs(ours - shown[0]).mean() < 0.01
    assert alike(ours, shown[1]) < 0.97
    assert np.abs(shown[2] - shown[0]).max() < 0.02


def test_every_kind_of_shape_shows_its_pattern_where_ours_has_it():
    lens = CameraConfig(width=64, height=48, mount="body", texture_period_m=1.0)
    axis, half = rotation_of(0.5, 0.6, 0.0), np.array([1.0, 0.6, 1.4])
    grey, at = np.full(3, 0.5), np.array([30.0, 30.0, 6.0])
    shapes = [
        box(30, 30, 6, 1.0, 0.6, 1.4, 0.5),
        pillar(30, 30, 6, 0.8, 1.5),
        Spheres(position=at, radius=1.3, albedo=grey),
        TiltedBoxes(position=at, half=half, rotation=axis, albedo=grey),
        Capsules(position=at, axis=axis[:, 2], half_length=1.0, radius=0.6, albedo=grey),
        TiltedCylinders(position=at, axis=axis[:, 2], half_length=1.2, radius=0.8, albedo=grey),
    ]
    for shape in shapes:
        scene = scene_of(shape)
        for turn in (rotation_of(0, 0, 0), rotation_of(0, 0.9, 2.5)):
            eye = at - 4.0 * turn[:, 0]
            ours = np.asarray(camera.render_luma(lens, scene, eye.astype(np.float32), turn.astype(np.float32)))
            plain = _luma(mujoco.MjSpec.from_string(mjcf_of(scene)), lens, eye, turn)
            # The sky is of one brightness in each.
            of_shape = np.abs(plain - plain[0, 0]) > 0.02
            inside = of_shape & np.roll(of_shape, 2, 0) & np.roll(of_shape, -2, 0)
            inside &= np.roll(of_shape, 2, 1) & np.roll(of_shape, -2, 1)
            shown = _luma(painted_spec(lens, scene), lens, eye, turn)
            assert inside.sum() > 100
            pattern, drawn = ((image / plain)[inside] for image in (ours, shown))
            assert alike(pattern, drawn) > 0.97 and np.std(pattern) > 0.05, type(shape)
            assert np.abs(pattern - drawn).mean() < 0.01, type(shape)


def _luma(spec: mujoco.MjSpec, lens: CameraConfig, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    drawn = pictures.mujoco_pictures(spec, lens)
    try:
        return drawn.see(position, rotation)
    finally:
        drawn.close()


def test_a_camera_that_cannot_draw_is_one_sentence(monkeypatch):
    def refuse(*_: object) -> None:
        raise RuntimeError("no display")

    monkeypatch.setattr(mujoco, "Renderer", refuse)
    with pytest.raises(edqn_jax.ConfigError, match="libosmesa6"):
        mujoco_luma("plain")


def test_one_mission_in_mujocos_picture_and_rotorpys_flight(tmp_path: Path):
    file = tmp_path / "cell.json"
    words = ["--world", "medium", "--look", "plain", "--flight", "rotorpy", "--missions", "1", "--json", str(file)]
    assert transfer.main(words) == 0
    assert '"flight": "rotorpy"' in file.read_text()
