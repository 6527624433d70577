"""Large faces of meshes, seen at any angle, beside the same faces of boxes."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera import camera
from edqn_jax.sim.scene.mjcf import load_scene
from tests.support.marks import in_whole
from tests.support.meshes import CUBE, hull, mesh_world

SIZES = np.array([[6.0, 3.0, 0.4], [6.0, 0.3, 2.0]])
PLACES = np.array([[10.0, 5.0, 1.0], [10.0, 8.3, 2.6]])


@pytest.mark.whole
@pytest.mark.parametrize("mount", ["body", *in_whole("level")])
def test_the_texture_of_faces_seen_at_a_low_angle_is_averaged_as_that_of_boxes(mount: str, tmp_path: Path) -> None:
    """A floor and a wall, both 12 m long, and an eye close to them."""
    text = [" ".join(map(str, size)) for size in SIZES]
    at = [" ".join(map(str, place)) for place in PLACES]
    (tmp_path / "boxes").mkdir()
    boxes = mesh_world(
        tmp_path / "boxes",
        "".join(f'<geom type="box" size="{s}" pos="{p}"/>' for s, p in zip(text, at, strict=True)),
    )
    cubes = {f"m{i}": hull(CUBE * size) for i, size in enumerate(SIZES)}
    meshes = mesh_world(
        tmp_path, "".join(f'<geom type="mesh" mesh="m{i}" pos="{p}"/>' for i, p in enumerate(at)), **cubes
    )
    config = CameraConfig(width=32, height=24, texture_contrast=0.6, mount=mount)  # type: ignore[arg-type]
    places = jnp.asarray([[5.0, 7.0, 1.8], [4.5, 6.0, 2.4]])

    def pictures(file: Path) -> np.ndarray:
        scene = load_scene(file)
        draw = jax.jit(jax.vmap(lambda place: camera.render_luma(config, scene, place, jnp.eye(3))))
        return np.asarray(draw(places))

    apart = np.abs(pictures(boxes) - pictures(meshes))
    assert apart.mean() < 0.003
