"""Distances of meshes on grids: exact where they are computed, never too large between."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from trimesh import Trimesh
from trimesh.triangles import closest_point

from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene import mesh_field
from edqn_jax.sim.scene.mesh_field import CELL_M, Grid, convex_distances, grid_of_mesh
from tests.support.meshes import CUBE, ball, hull

CLOUD = np.random.default_rng(5).normal(size=(20, 3))


def interpolated(grid: Grid, points: np.ndarray) -> np.ndarray:
    axes = [grid.cell * (np.arange(n) - (n - 1) / 2) for n in grid.values.shape]
    return RegularGridInterpolator(axes, grid.values)(points)


@pytest.mark.parametrize("points", [CUBE * [1.03, 0.62, 0.44], CLOUD], ids=["box", "cloud"])
def test_exact_distances_are_those_to_the_nearest_of_all_triangles(points: np.ndarray) -> None:
    vertices, faces = hull(points)
    asked = np.random.default_rng(0).uniform(-3, 3, (300, 3))
    pairs = np.repeat(asked, len(faces), axis=0), np.tile(vertices[faces], (len(asked), 1, 1))
    away = np.linalg.norm(closest_point(pairs[1], pairs[0]) - pairs[0], axis=1).reshape(len(asked), -1).min(1)
    found = convex_distances(asked, vertices, faces)
    np.testing.assert_allclose(np.abs(found), away, atol=1e-9)
    plane = hull(points)[0]
    normals = Trimesh(plane, faces, process=False).face_normals
    inside = np.all(np.sum((asked[:, None] - vertices[faces[:, 0]]) * normals, axis=2) <= 0, axis=1)
    assert np.array_equal(found <= 0, inside) and inside.any()


@pytest.mark.parametrize(
    "mesh",
    [hull(CUBE * [1.03, 0.62, 0.44]), hull(CLOUD), ball(), hull(CUBE * [1, 0.5, 0.015])],
    ids=["box", "cloud", "ball", "sheet"],
)
def test_between_its_values_a_grid_is_at_most_half_a_cell_too_small_and_never_too_large(
    mesh: tuple[np.ndarray, np.ndarray],
) -> None:
    grid, middle = grid_of_mesh(*mesh, CELL_M)
    points = np.random.default_rng(1).uniform(-1, 1, (10_000, 3)) * (grid.half + mesh_field.MARGIN_M)
    exact = convex_distances(points + middle, *mesh)
    error = interpolated(grid, points) - exact
    assert error.min() > -0.05
    assert error[np.abs(exact) < 0.2].max() < 0.01 and error[exact > 0].max() < 0.01


def test_distances_to_a_mesh_of_many_triangles_are_at_most_a_little_too_small() -> None:
    points = np.random.default_rng(2).uniform(-1.5, 1.5, (2000, 3))
    away = np.linalg.norm(points, axis=1) - 1
    vertices, faces = ball(1000)
    smallest = np.linalg.norm(vertices[faces].mean(1), axis=1).min()
    found = convex_distances(points, vertices, faces)
    near = np.abs(away) < 0.5
    assert np.all(np.abs(found[near] - away[near]) < 0.006) and np.all(found <= away + 1 - smallest + 1e-9)
    # A lid of a fine cylinder is flat, and its rim is round further out.
    turn = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn), np.ones(400)], axis=1)
    asked = np.array([[0.3, 0.2, 1.3], [1.3, 0, 1.4], [1.4, 0.1, 0.2]])
    found = convex_distances(asked, *hull(np.concatenate([ring, ring * [1, 1, -1]])))
    np.testing.assert_allclose(found, [0.3, 0.5, np.hypot(1.4, 0.1) - 1], atol=0.005)


@pytest.mark.whole
def test_a_thin_mesh_has_small_cells_and_a_large_one_none_below_a_decimetre() -> None:
    assert grid_of_mesh(*hull(CUBE * [0.02, 0.02, 0.3]))[0].cell == 0.05
    assert grid_of_mesh(*hull(CUBE * [6, 0.05, 2]))[0].cell == CELL_M


def bad_mesh(name: str) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = hull(CUBE)
    if name == "open":
        return vertices, faces[1:]
    if name == "turned":
        return vertices, np.concatenate([faces[:1, ::-1], faces[1:]])
    if name == "inside out":
        return vertices, faces[:, ::-1]
    if name == "nan":
        return np.where(np.arange(8)[:, None] == 3, np.nan, vertices), faces
    if name == "flat":
        return vertices * [1, 1, 0], faces
    return vertices * 100, faces


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("open", "is not watertight: 3 edges of its 11 triangles"),
        ("turned", "is not watertight"),
        ("inside out", "is inside out"),
        ("nan", "has a vertex that is not finite"),
        ("flat", "is flat"),
        (
            "huge",
            r"measures 200 x 200 x 200 m, .* would be .* values; a mesh may have 4,194,304.*millimetres",
        ),
    ],
)
def test_a_mesh_that_cannot_be_a_field_is_refused_in_one_sentence(name: str, says: str) -> None:
    vertices, faces = bad_mesh(name)
    with pytest.raises(ConfigError, match=says) as raised:
        grid_of_mesh(vertices, faces)
    assert "\n" not in str(raised.value)


def test_a_mesh_of_too_many_triangles_is_refused_before_it_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_field, "MOST_TRIANGLES", 11)
    with pytest.raises(ConfigError, match="has 12 triangles; it may have 11"):
        grid_of_mesh(*hull(CUBE))
