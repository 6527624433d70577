"""Distances of meshes of any form on grids: exact where they are computed, and thin walls are still there."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from edqn_jax.sim.scene.grid_boxes import MOST_BOXES, boxes_of_grid
from edqn_jax.sim.scene.mesh_field import CELL_M, Grid, _cell_for, grid_of_mesh
from edqn_jax.sim.scene.solid_distance import EXACT_CELLS, lattice_axes, points_on, solid_distances, split_triangles
from tests.oracles.mesh_distance import signed_distances
from tests.support.marks import in_whole

TURN = Rotation.from_euler("xyz", [20, 35, 50], degrees=True).as_matrix()


def boxes(*bounds: list[list[float]]) -> trimesh.Trimesh:
    """Overlapping boxes."""
    parts = [trimesh.creation.box(bounds=each) for each in bounds]
    return trimesh.Trimesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + 8 * i for i, part in enumerate(parts)]),
        process=False,
    )


def corner(thick: float) -> list[list[list[float]]]:
    """Three walls that meet in a corner."""
    return [[[0, 0, 0], [thick, 2, 2]], [[0, 0, 0], [2, thick, 2]], [[0, 0, 0], [2, 2, thick]]]


WALL, SHEET = 0.2, 0.01
BOXES = {
    "steps": [[[0, 0, 0], [2, 0.6, 1]], [[0, 0, 0], [0.6, 2, 1]]],
    "walls": corner(WALL),
    "sheets": corner(SHEET),
}
"""By name: lowest and highest corners."""

MESHES = {"ring": trimesh.creation.torus(1, 0.3)} | {name: boxes(*bounds) for name, bounds in BOXES.items()}


def interpolated(grid: Grid, points: np.ndarray) -> np.ndarray:
    return RegularGridInterpolator(lattice_axes(np.array(grid.values.shape), grid.cell), grid.values)(points)


@pytest.mark.whole
def test_distances_on_a_lattice_are_exact_near_the_surface_and_a_little_small_elsewhere() -> None:
    mesh = MESHES["ring"]
    counts = np.array([41, 41, 21])
    triangles = mesh.vertices[mesh.faces]
    corners, middles = solid_distances(triangles, counts, 0.1)
    for values, shift in ((corners, 0.0), (middles, 0.05)):
        at = np.argwhere(np.isfinite(values))[::40]
        exact = signed_distances(triangles, 0.1 * (at - (counts - 1) / 2) + shift)
        error = values[tuple(at.T)] - exact
        near = np.abs(exact) < 0.1 * EXACT_CELLS
        assert near.sum() > 50 and np.abs(error[near]).max() < 1e-5
        assert np.abs(error).max() < 0.012
        if not shift:
            assert np.all(np.abs(values[tuple(at.T)][~near]) < np.abs(exact[~near]) + 0.005)
    assert np.isinf(middles).any() and (corners < 0).any()


@pytest.mark.whole
def test_far_from_many_things_no_distance_is_too_large() -> None:
    # Half way between two things, the nearest point beside a surface is often not beside the nearest surface.
    rng = np.random.default_rng(3)
    low = rng.uniform(-2.5, 2.5, (30, 3))
    bounds = np.stack([low, low + rng.uniform(0.02, 0.3, (30, 3))], axis=1)
    mesh, counts = boxes(*bounds), np.array([61, 61, 61])
    corners, _ = solid_distances(mesh.vertices[mesh.faces], counts, 0.1)
    points = np.stack(np.meshgrid(*lattice_axes(counts, 0.1), indexing="ij"), -1)[..., None, :]
    exact = np.linalg.norm(np.maximum(np.maximum(bounds[:, 0] - points, points - bounds[:, 1]), 0.0), axis=-1).min(-1)
    error = (corners - exact)[exact > 0.1 * EXACT_CELLS]
    # A margin of a tenth of a cell is taken off; compared with too few triangles it would not be enough.
    assert error.size > 100_000 and error.max() < 1e-5 and error.min() > -0.012


EVERY_DAY = [("ring", False), ("walls", True)]
OTHERS = [each for each in itertools.product(MESHES, (False, True)) if each not in EVERY_DAY]


@pytest.mark.whole
@pytest.mark.parametrize(
    ("name", "turned"), [*EVERY_DAY, *(pytest.param(*each, marks=pytest.mark.whole) for each in OTHERS)]
)
def test_between_its_values_a_grid_is_hardly_ever_half_a_cell_too_small_and_never_too_large(
    name: str, turned: bool
) -> None:
    mesh, rng = MESHES[name], np.random.default_rng(1)
    vertices = mesh.vertices @ TURN.T + [0.03, 0.02, 0.01] if turned else np.asarray(mesh.vertices)
    grid, middle = grid_of_mesh(vertices, mesh.faces, CELL_M)
    assert not grid.is_convex
    triangles = (vertices - middle)[mesh.faces]
    beside = trimesh.sample.sample_surface(trimesh.Trimesh(vertices - middle, mesh.faces), 400, seed=1)[0]
    points = np.concatenate(
        [rng.uniform(-1, 1, (600, 3)) * (grid.half + 0.4), beside, beside + rng.normal(0, 0.1, beside.shape)]
    )
    exact = signed_distances(triangles, points)
    error = interpolated(grid, points) - exact
    assert error[np.abs(exact) < 0.2].max() < 0.01 and error[exact > -1e-9].max() < 0.01
    outside = error[exact > -1e-9]
    assert outside.min() > -0.1 and np.mean(outside < -0.05) < 0.03


@pytest.mark.parametrize("name", ["sheets", *in_whole("steps", "walls")])
def test_of_1e5_points_outside_boxes_hardly_any_distance_is_half_a_cell_off(name: str) -> None:
    mesh, bounds = boxes(*BOXES[name]), np.array(BOXES[name])
    grid, middle = grid_of_mesh(mesh.vertices @ TURN.T, mesh.faces, CELL_M)
    points = np.random.default_rng(7).uniform(-1, 1, (100_000, 3)) * (grid.half + 0.4)
    there = ((points + middle) @ TURN)[:, None]
    # Outside of several boxes the nearest is that of the union.
    beyond = np.maximum(np.maximum(bounds[:, 0] - there, there - bounds[:, 1]), 0.0)
    exact = np.linalg.norm(beyond, axis=-1).min(1)
    error = (interpolated(grid, points) - exact)[exact > 0]
    assert error[exact[exact > 0] < 0.2].max() < 0.01 and error.max() < 0.012
    # Further off beside inner corners alone, where the distances of two walls meet.
    assert error.min() > -0.1 and np.mean(error < -0.05) < 0.001


def test_a_sheet_between_two_points_of_the_grid_does_not_vanish() -> None:
    # Both neighbouring points lie outside of it: one 2 cm away, the other one 7.
    sheet = boxes([[0, 0, 0], [0.01, 3, 3]], [[0, 0, 0], [3, 3, 0.01]])
    grid, middle = grid_of_mesh(np.asarray(sheet.vertices) + [0.013, 0.0, 0.0], sheet.faces, CELL_M)
    across = np.stack([np.linspace(-0.3, 0.3, 200), np.full(200, 0.1), np.full(200, 0.3)], axis=1)
    across[:, 0] += 0.018 - middle[0]
    assert interpolated(grid, across).min() <= 0.001


def test_solids_that_share_an_edge_or_overlap_are_closed() -> None:
    touching = boxes([[0, 0, 0], [1, 1, 1]], [[1, 1, 0], [2, 2, 1]], [[0.5, 0.5, 0.5], [1.5, 1.5, 2]])
    grid, middle = grid_of_mesh(touching.vertices, touching.faces)
    inside = interpolated(grid, np.array([[0.5, 0.5, 0.3], [1.5, 1.5, 0.3], [0.8, 0.8, 0.8], [0.2, 1.8, 0.3]]) - middle)
    assert np.all(inside[:3] < 0) and inside[3] > 0.25


def test_a_large_mesh_has_larger_cells() -> None:
    assert _cell_for(np.array([10, 6, 3.2]), False) == CELL_M
    assert _cell_for(np.array([20, 10, 5]), False) == pytest.approx(0.15625)


def test_split_triangles_cover_the_same_area_and_are_small() -> None:
    triangles = MESHES["sheets"].triangles
    parts = split_triangles(triangles, 0.3)
    edges = np.linalg.norm(parts - np.roll(parts, 1, axis=1), axis=2)
    assert edges.max() <= 0.3
    assert trimesh.triangles.area(parts).sum() == pytest.approx(trimesh.triangles.area(triangles).sum())


@pytest.mark.parametrize("parts", range(1, 5))
def test_points_on_a_triangle_are_the_middles_of_its_equal_parts(parts: int) -> None:
    triangle = np.array([[[0, 0, 1], [3, 0, 1], [0, 3, 1]]], float)
    points = points_on(triangle, 1.001 * np.sqrt(18) / parts)
    x = points * parts  # thirds of a part beside each corner of the parts
    lower = {(3 * i + 1, 3 * j + 1) for i in range(parts) for j in range(parts - i)}
    upper = {(3 * i + 2, 3 * j + 2) for i in range(parts) for j in range(parts - i - 1)}
    assert {tuple(each) for each in np.round(x[:, :2]).astype(int)} == lower | upper
    assert len(points) == parts**2 and np.allclose(points[:, 2], 1) and np.allclose(x[:, :2], np.round(x[:, :2]))


def test_of_points_on_a_surface_the_next_one_is_near() -> None:
    triangles = np.array([[[0, 0, 0], [7, 0, 0], [0.3, 0.4, 0.2]]])
    points = points_on(triangles, 0.1)
    shares = np.random.default_rng(0).dirichlet(np.ones(3), 2000)
    apart = np.linalg.norm((shares @ triangles[0])[:, None] - points, axis=-1).min(1)
    assert apart.max() <= 0.1 * 2 / 3


def test_a_grid_is_drawn_as_boxes_around_what_is_filled() -> None:
    grid, middle = grid_of_mesh(MESHES["walls"].vertices, MESHES["walls"].faces)
    drawn = boxes_of_grid(grid)
    assert len(drawn) < 30
    volume = np.prod(drawn[:, 1] - drawn[:, 0], axis=1).sum()
    assert volume == pytest.approx(2.17, rel=0.25)
    ring, _ = grid_of_mesh(MESHES["ring"].vertices @ TURN, MESHES["ring"].faces)
    assert 50 < len(boxes_of_grid(ring)) <= MOST_BOXES
