"""Rays through fields in C are those in JAX, however they are mapped, and meet what MuJoCo's do."""

from __future__ import annotations

import dataclasses
import re
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh

from edqn_jax.config import SHAPES
from edqn_jax.native import build
from edqn_jax.sim.scene.mesh_field import Grid
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.shapes import field_rays
from edqn_jax.sim.scene.shapes.field import Fields, _least_of_blocks
from edqn_jax.sim.scene.shapes.kind import TINY
from tests.support.meshes import CUBE, hull, mesh_world

RING = trimesh.creation.torus(1.2, 0.3, major_sections=24, minor_sections=12)
GEOMS = (
    '<geom name="ring" type="mesh" mesh="ring" pos="8 5 3" euler="0 70 20"/>'
    '<geom name="block" type="mesh" mesh="block" pos="12 5 3" euler="0 0 30"/>'
)
MESHES = {"ring": (np.asarray(RING.vertices), np.asarray(RING.faces)), "block": hull(CUBE * [0.43, 2.02, 1.51])}
"""None of their faces is a plane of a grid, to either side of which a place may be rounded."""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return mesh_world(tmp_path, GEOMS, **MESHES)


@pytest.fixture(params=["c", "jax"])
def in_c_or_jax(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs a test with rays in C, where there is a compiler, and again with those in JAX."""
    if request.param == "jax":
        monkeypatch.setattr(field_rays, "is_available", lambda platform: False)


def rays_ahead() -> np.ndarray:
    """Rays [13, 17, 3] along x and around, not as many as go together."""
    across, up = np.meshgrid(np.linspace(-0.6, 0.6, 17), np.linspace(0.4, -0.4, 13))
    return np.stack([np.ones_like(across), across, up], axis=-1).astype(np.float32)


def meet(fields: Any, origin: Any, rays: Any) -> tuple[Any, ...]:
    """Depths, which are met, and normals."""
    met = SHAPES.get("fields").meet(fields, origin, tuple(rays[None, ..., i] for i in range(3)))
    return met.depth, met.hit, *met.normal


def compare(monkeypatch: pytest.MonkeyPatch, mapped: Any, *given: Any) -> tuple[np.ndarray, ...]:
    """The results where there is a compiler, in C, once they are those in JAX."""
    assert field_rays.is_available("cpu") is (shutil.which("cc") is not None)
    in_c = [np.asarray(part) for part in jax.jit(lambda *args: mapped(*args))(*given)]
    monkeypatch.setattr(field_rays, "is_available", lambda platform: False)
    in_jax = [np.asarray(part) for part in jax.jit(lambda *args: mapped(*args))(*given)]
    depth, hit = in_c[:2]
    assert hit.any() and not hit.all()
    np.testing.assert_array_equal(hit, in_jax[1])
    np.testing.assert_allclose(depth, in_jax[0], rtol=1e-3)
    # At edges a place may be rounded into either of two cells, which have other slopes.
    for ours, theirs, apart in zip(in_c, in_jax, (1e-5, 0, 1e-3, 1e-3, 1e-3), strict=True):
        assert np.isclose(ours.astype(float), theirs.astype(float), rtol=apart, atol=apart).mean() > 0.99
    return tuple(in_c)


def test_the_constants_in_c_are_those_of_python() -> None:
    found = re.findall(r"^#define (\w+) ([\d.e+-]+)f?\b", field_rays.HEADERS[0].read_text(), re.MULTILINE)
    own = {"AT_ONCE": ("1", "2"), "TOGETHER": ("1", str(field_rays.TOGETHER))}
    assert {value for name, value in found if name == "TOGETHER"} == {*own["TOGETHER"]}
    shared = ("STEPS", "STOPS", "CONE", "BLOCK", "PER_CELL", "FAR_M", "REFINED", "WORTH", "ROUNDED")
    finer = ("FINER_STEPS", "FINER_WORTH", "FINER_ROOM")
    assert dict(each for each in found if each[0] not in own).keys() == {"TINY", *shared, *finer}
    for name, value in found:
        if name not in own:
            assert float(value) == (TINY if name == "TINY" else getattr(field_rays, name))


def test_c_meets_what_jax_meets_and_mujoco(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fields, origin, rays = load_scene(file).others["fields"], np.array([4.0, 4.6, 3.2], np.float32), rays_ahead()
    depth, hit, *normal = compare(monkeypatch, meet, fields, jnp.asarray(origin), jnp.asarray(rays))
    assert depth.shape == (2, 13, 17)
    np.testing.assert_allclose(np.linalg.norm([part[hit] for part in normal], axis=0), 1.0, atol=1e-4)
    nearest = np.where(hit, depth, np.inf).min(0)
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    theirs, geom = np.empty((13, 17)), np.zeros(1, np.int32)
    for place in np.ndindex(13, 17):
        ray = rays[place].astype(np.float64)
        there = mujoco.mj_ray(model, data, origin.astype(np.float64), ray, None, 1, -1, geom)
        theirs[place] = np.inf if there < 0 or geom[0] == 0 else there
    assert np.isclose(nearest, theirs, rtol=0.05).mean() > 0.93
    assert np.isinf(theirs).sum() > 30 and np.isfinite(theirs).sum() > 60


ORIGINS = jnp.array([[4.0, 4.6, 3.2], [4.5, 5.4, 2.9], [2.0, 5.0, 3.0]])
SHIFTS = jnp.array([[0.0, 0.0, 0.0], [0.2, 0.1, 0.0]])


def meet_moved(file: Path) -> Any:
    """A function of how far the fields are shifted, and of the origin, that meets them."""
    fields, rays = load_scene(file).others["fields"], jnp.asarray(rays_ahead())
    return lambda shift, origin: meet(fields.replace(position=fields.position + shift), origin, rays)


def over_all(moved: Any) -> Any:
    return jax.vmap(jax.vmap(moved, in_axes=(None, 0)), in_axes=(0, None))


@pytest.mark.whole
@pytest.mark.slow
def test_frames_and_worlds_that_are_mapped_are_those_one_by_one(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved = meet_moved(file)
    depth, *_ = compare(monkeypatch, over_all(moved), SHIFTS, ORIGINS)
    monkeypatch.undo()
    alone = jax.jit(moved)(SHIFTS[1], ORIGINS[2])[0]
    np.testing.assert_allclose(np.minimum(depth[1, 2], 1e9), np.minimum(alone, 1e9), rtol=1e-6)


@pytest.fixture(scope="module")
def kernel() -> bool:
    """Whether the kernel of GPUs is registered for the CPU, where there is a compiler."""
    on_cpu = Path(__file__).parents[2] / "oracles" / "cuda_on_cpu.h"
    words = "-xc", "-include", str(on_cpu), f"-D{field_rays.TARGET}=emulated_{field_rays.TARGET}"
    compiler = dataclasses.replace(build.C, flags=(*build.C.flags, *words))
    headers = *field_rays.HEADERS, on_cpu
    return build.ensure_registered(
        field_rays.SOURCES["cu"], (f"emulated_{field_rays.TARGET}",), by=compiler, headers=headers
    )


@pytest.mark.whole
@pytest.mark.slow
def test_the_kernel_of_gpus_meets_what_c_meets(kernel: bool, file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the CPU, thread by thread."""
    if not kernel:
        assert shutil.which("cc") is None
        return
    every = over_all(meet_moved(file))
    in_c = [np.asarray(part) for part in jax.jit(lambda *given: every(*given))(SHIFTS, ORIGINS)]
    monkeypatch.setattr(field_rays, "TARGET", f"emulated_{field_rays.TARGET}")
    in_cuda = [np.asarray(part) for part in jax.jit(lambda *given: every(*given))(SHIFTS, ORIGINS)]
    # A ray by itself begins elsewhere than one with its neighbours, and ends at the same place.
    assert np.mean(in_c[1] == in_cuda[1]) > 0.999
    both = in_c[1] & in_cuda[1]
    assert both.sum() > 300
    assert np.isclose(in_c[0][both], in_cuda[0][both], atol=1e-4).mean() > 0.99
    along = np.sum([ours[both] * theirs[both] for ours, theirs in zip(in_c[2:], in_cuda[2:], strict=True)], axis=0)
    assert np.mean(along > 0.999) > 0.99


def test_a_ray_along_a_wall_arrives_at_the_one_behind(tmp_path: Path) -> None:
    # Along a wall every step is short; nearer to it the ray ends somewhere at the wall, and never in the sky.
    parts = [
        trimesh.creation.box(bounds=bounds)
        for bounds in ([[0, 0, 0], [14, 0.2, 3]], [[0, 4, 0], [14, 4.2, 3]], [[13.8, 0, 0], [14, 4, 3]])
    ]
    vertices = np.concatenate([part.vertices for part in parts])
    walls = vertices, np.concatenate([part.faces + 8 * i for i, part in enumerate(parts)])
    scene = load_scene(mesh_world(tmp_path, '<geom type="mesh" mesh="m" pos="2 2 1"/>', m=walls))
    rays = jnp.asarray(np.tile(np.array([1, 0.004, 0], np.float32), (1, 8, 1)))
    for y, least in np.array([[2.5, 12.7], [2.35, 8.0]]):
        depth, hit, *_ = meet(scene.others["fields"], jnp.array([3.0, y, 2.0]), rays)
        assert bool(hit.all()) and least < float(depth[0, 0, 0]) < 12.81


def test_the_least_of_blocks_is_never_more_than_a_value_in_them() -> None:
    values = np.random.default_rng(0).normal(size=(10, 9, 6))
    least = _least_of_blocks(values)
    assert least.shape == (3, 2, 2)
    for place in np.ndindex(*least.shape):
        block = values[tuple(slice(4 * i, 4 * i + 5) for i in place)]
        assert least[place] == block.min()


@pytest.mark.usefixtures("in_c_or_jax")
def test_a_plate_of_a_millimetre_is_seen_from_the_front_and_aslant(tmp_path: Path) -> None:
    """A ray that only stopped some way within a surface would pass through it: the plate lies on points of its grid."""
    plate = trimesh.creation.box(extents=[0.001, 3, 2])
    stand = trimesh.creation.box(extents=[0.6, 0.3, 0.3]).apply_translation([0, 0, -1.2])
    both: Any = trimesh.util.concatenate([plate, stand])
    geom = '<geom name="plate" type="mesh" mesh="plate" pos="8 5 3"/>'
    file = mesh_world(tmp_path, geom, plate=(np.asarray(both.vertices), np.asarray(both.faces)))
    fields = load_scene(file).others["fields"]
    assert not fields.grids[0].is_convex
    for origin in ([4.0, 5.0, 3.2], [7.0, 2.0, 3.0], [7.3, 3.0, 3.1]):
        aim = np.array([8.0, 5.0, 3.0]) + np.random.default_rng(0).uniform(-1, 1, (64, 3)) * [0, 1.3, 0.8]
        rays = (aim - origin).astype(np.float32).reshape(8, 8, 3)
        depth, hit, *_ = jax.jit(lambda o, r: meet(fields, o, r))(jnp.asarray(origin), jnp.asarray(rays))
        assert np.all(hit)
        np.testing.assert_allclose(np.asarray(depth), 1, atol=0.1)


@pytest.mark.whole
@pytest.mark.usefixtures("in_c_or_jax")
def test_no_ray_reads_beyond_a_grid_so_long_that_32_bits_round_its_numbers() -> None:
    half, nothing = np.array([20100.0, 0.4, 0.4]), (np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    free = Grid.of(np.full((40001, 2, 2), 3.0), 1.0, half, *nothing)
    # What is beyond the first grid is the second.
    full = Grid.of(np.full((2, 2, 2), -3.0), 1.0, half, *nothing)
    place = jnp.zeros((1, 3)), jnp.eye(3)[None], jnp.asarray(half, jnp.float32)[None], jnp.zeros(1), jnp.ones((1, 3))
    rays = jnp.asarray(np.tile(np.array([1, 0.0001, 0], np.float32), (1, 8, 1)))
    _, hit, *_ = meet(Fields(*place, grids=(free, full)), jnp.array([19990.0, 0.0, 0.0]), rays)
    assert not bool(hit.any())


@pytest.mark.whole
@pytest.mark.usefixtures("in_c_or_jax")
def test_a_ray_that_comes_near_to_wide_ground_and_leaves_it_meets_nothing() -> None:
    height = np.broadcast_to(0.1 * (np.arange(41.0) - 20), (641, 5, 41))
    half = np.array([31.0, 0.15, 1.9])
    ground = Grid.of(height, 0.1, half, np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    place = jnp.zeros((1, 3)), jnp.eye(3)[None], jnp.asarray(half, jnp.float32)[None], jnp.zeros(1), jnp.ones((1, 3))
    rays = np.tile(np.array([1, 0, -0.005], np.float32), (1, 8, 1))
    rays[0, 4:, 2] = -0.02  # arrives
    depth, hit, *_ = meet(Fields(*place, grids=(ground,)), jnp.array([-30.0, 0.0, 0.5]), jnp.asarray(rays))
    np.testing.assert_array_equal(hit[0, 0], [False] * 4 + [True] * 4)
    np.testing.assert_allclose(depth[0, 0, 4:], 25, rtol=0.01)
