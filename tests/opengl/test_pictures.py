"""MuJoCo's pictures of our worlds. `.ci/run` runs this where there is EGL: `MUJOCO_GL=egl pytest -n0 tests/opengl`."""

from __future__ import annotations

import functools
from pathlib import Path

import mujoco
import numpy as np
import pytest

import edqn_jax
from edqn_jax.sim.environment import Environment
from outer import pictures
from outer.poses import camera_rotation

import transfer  # isort: skip

pytestmark = pytest.mark.filterwarnings("ignore")  # rotorpy, jax2onnx and what they import


@functools.cache
def medium() -> Environment:
    return edqn_jax.make("medium", edqn_jax.load_policy("pretrained").config, worlds=2, split="test")


def mujoco_luma(look: str, seed: int = 3) -> np.ndarray:
    scene = medium().scene(0)
    drawn = pictures.mujoco_pictures(pictures.spec_of(medium().mjcf(0), look, seed), medium().config.camera)
    try:
        return drawn.see(np.asarray(scene.start, np.float64), _towards_goal())
    finally:
        drawn.close()


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
    plain, textured, shadows = (mujoco_luma(look) for look in pictures.LOOKS)
    assert np.abs(textured - plain).mean() > 0.02
    assert np.abs(shadows - plain).max() > 0.02
    # The camera stands within the site `start`, which would be all that it sees.
    assert np.ptp(plain) > 0.2
    assert np.array_equal(mujoco_luma("textured"), textured)
    assert np.abs(mujoco_luma("textured", seed=4) - textured).mean() > 0.02


def test_a_camera_that_cannot_draw_is_one_sentence(monkeypatch):
    def refuse(*_: object) -> None:
        raise RuntimeError("no display")

    monkeypatch.setattr(mujoco, "Renderer", refuse)
    with pytest.raises(edqn_jax.ConfigError, match="libosmesa6"):
        mujoco_luma("plain")


def test_one_mission_with_nothing_of_ours(tmp_path: Path):
    file = tmp_path / "cell.json"
    words = ["--world", "medium", "--look", "plain", "--flight", "rotorpy", "--missions", "1", "--json", str(file)]
    assert transfer.main(words) == 0
    assert '"flight": "rotorpy"' in file.read_text()
