"""The example building: made by its script, flown, and seen as MuJoCo's rays see it."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ElementTree
from types import ModuleType

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera import camera
from edqn_jax.sim.scene.mjcf import check_scene, load_world
from edqn_jax.sim.scene.mjcf_parts.files import load_checked_text
from tests.support.pages import ROOT

FILE = ROOT / "scenes/examples/building.xml"
PLACES = np.array([[3.0, 7.0, 1.9], [11.0, 5.0, 4.5], [20.0, 9.0, 6.0]])
CONFIG = CameraConfig(width=32, height=24)


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_building", ROOT / "scripts/make_building.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_its_mesh_is_the_one_that_the_script_makes(script: ModuleType) -> None:
    mesh, file = script.building(), FILE.with_suffix(".obj")
    assert 45_000 < len(mesh.faces) < 65_000 and file.stat().st_size < 2_000_000
    lines = file.read_text().splitlines()
    vertices = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    faces = np.array([line.split()[1:] for line in lines if line.startswith("f ")], int) - 1
    np.testing.assert_allclose(vertices[faces], np.asarray(mesh.vertices)[mesh.faces], atol=6e-4)


def rays_of_mujoco(places: np.ndarray) -> np.ndarray:
    """Metres [M, 24, 32] along the middle ray of each pixel of cameras that look along x."""
    model = mujoco.MjModel.from_xml_string(load_checked_text(FILE))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    half, geom = np.tan(np.radians(CONFIG.horizontal_fov_deg) / 2), np.zeros(1, np.int32)
    found = np.empty((len(places), 24, 32))
    for m, row, column in np.ndindex(found.shape):
        way = np.array([1, half * (1 - 2 * (column + 0.5) / 32), 0.75 * half * (1 - 2 * (row + 0.5) / 24)])
        there = mujoco.mj_ray(model, data, places[m], way / np.linalg.norm(way), None, 1, -1, geom)
        found[m, row, column] = np.inf if there < 0 else there
    return found


def test_the_ground_floor_is_the_same_mesh_below_its_ceiling() -> None:
    whole, floor = (ElementTree.parse(FILE.with_name(f"{name}.xml")).getroot() for name in ("building", "ground_floor"))
    for kind in ("mesh", "geom", "light"):
        assert [each.attrib for each in whole.iter(kind)] == [each.attrib for each in floor.iter(kind)]
    (volume,) = (site for site in floor.iter("site") if site.get("name") == "volume")
    assert (volume.get("pos"), volume.get("size")) == ("12 7 2", "12 7 2")


@pytest.mark.whole
@pytest.mark.slow
def test_a_drone_fits_and_sees_what_mujoco_sees() -> None:
    world = load_world(FILE)
    check_scene(world.scene, 0.36, names=world.names, goal_radius=2.0)
    see = jax.jit(jax.vmap(lambda place: camera.render_depth(CONFIG, world.scene, place, jnp.eye(3))))
    depth = np.asarray(see(jnp.asarray(PLACES, jnp.float32)))
    assert np.isclose(depth, rays_of_mujoco(PLACES), rtol=0.05).mean() > 0.95 and np.all(np.isfinite(depth))
