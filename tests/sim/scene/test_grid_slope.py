"""How fast interpolated distances change, and that steps of them end before small meshes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from edqn_jax.config import SHAPES
from edqn_jax.sim.scene.mesh_field import Grid, grid_of_mesh
from edqn_jax.sim.scene.shapes.kind import Geom
from tests.oracles.mesh_distance import signed_distances


def a_mesh(form: str, sizes: tuple[float, float, float], turn: int) -> trimesh.Trimesh:
    """Returns a ball, a box, a thin plate, or two of them in one, about a metre large, turned at random."""
    box, plate = trimesh.creation.box(sizes), trimesh.creation.box([sizes[0], sizes[1], 0.02])
    ball = trimesh.creation.icosphere(2, 0.5 * sizes[0])
    cross = trimesh.util.concatenate([plate, plate.copy().apply_transform(np.eye(4)[[2, 1, 0, 3]] * [-1, 1, 1, 1])])
    mesh = {"box": box, "plate": plate, "ball": ball, "cross": cross}[form]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.random.default_rng(turn).uniform(-3, 3, 3)).as_matrix()
    return mesh.apply_transform(pose)


MESHES = st.builds(
    a_mesh,
    st.sampled_from(["box", "plate", "ball", "cross"]),
    st.tuples(*[st.floats(0.3, 1.2)] * 3),
    st.integers(0, 1000),
)


def interpolated(grid: Grid) -> RegularGridInterpolator:
    axes = [grid.cell * (np.arange(count) - (count - 1) / 2) for count in grid.values.shape]
    return RegularGridInterpolator(axes, grid.values.astype(np.float64))


@pytest.mark.whole
@settings(max_examples=8, deadline=None)
@given(mesh=MESHES, seed=st.integers(0, 1000))
def test_distances_of_two_places_differ_by_no_more_than_the_slope_says(mesh: trimesh.Trimesh, seed: int) -> None:
    grid, _ = grid_of_mesh(mesh.vertices, mesh.faces)
    value, rng = interpolated(grid), np.random.default_rng(seed)
    reach = grid.cell * (np.array(grid.values.shape) - 1) / 2
    one = rng.uniform(-reach, reach, (4000, 3))
    other = np.clip(one + rng.normal(0, rng.choice([0.01, 0.1, 1.0], (4000, 1)), (4000, 3)), -reach, reach)
    apart = np.linalg.norm(one - other, axis=1)
    assert np.all(np.abs(value(one) - value(other)) <= grid.slope * apart + 1e-9)


@pytest.mark.whole
@settings(max_examples=4, deadline=None)
@given(mesh=MESHES)
def test_the_slope_is_the_largest_gradient_there_is(mesh: trimesh.Trimesh) -> None:
    grid, _ = grid_of_mesh(mesh.vertices, mesh.faces)
    value, counts = interpolated(grid), np.array(grid.values.shape)
    lower = np.stack(np.meshgrid(*(np.arange(n - 1) for n in counts), indexing="ij"), -1).reshape(-1, 3)
    steepest = 0.0
    for side in np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(8, 3):
        at, step = lower + np.where(side, 1 - 1e-3, 1e-3), np.where(side, -1e-3, 1e-3)
        here, there = (value(grid.cell * (place - (counts - 1) / 2)) for place in (at, at + np.eye(3)[:, None] * step))
        steepest = max(steepest, float(np.linalg.norm((there - here) / (1e-3 * grid.cell), axis=0).max()))
    assert steepest == pytest.approx(grid.slope, rel=0.02) and 1.0 < grid.slope < 4.0


@pytest.mark.whole
@settings(max_examples=4, deadline=None)
@given(mesh=MESHES, seed=st.integers(0, 1000))
def test_a_step_of_the_whole_distance_ends_before_the_mesh(mesh: trimesh.Trimesh, seed: int) -> None:
    one = SHAPES.get("fields").read(
        Geom("mesh", np.zeros(3), np.eye(3), np.ones(3), np.ones(3), (mesh.vertices, mesh.faces))
    )
    fields = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32)[None], one)
    points = np.random.default_rng(seed).uniform(-2, 2, (300, 3))
    distance = jax.vmap(lambda point: SHAPES.get("fields").distance(fields, *point)[0])
    ours = np.asarray(distance(jnp.asarray(points, jnp.float32)))
    theirs = signed_distances(np.asarray(mesh.triangles), points)
    assert np.max((ours - theirs)[theirs > 0]) < 0.01
