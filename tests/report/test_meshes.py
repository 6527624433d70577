"""Pictures of meshes show what is nearest to the eye, and their insides where they are cut."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from trimesh.creation import box, icosphere

from edqn_jax.report.worlds.flights import OBLIQUE, draw_map, plot_stage
from edqn_jax.report.worlds.meshes import EDGE, SECTION, Mesh, draw_meshes, floor_of, mesh_of_shape
from edqn_jax.report.worlds.solids import make_cutaway, standing_rows
from edqn_jax.report.worlds.views import MAP, View, pale, shaded
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.scene import Scene
from tests.support.meshes import mesh_world

UP = np.array([0.0, 0.0, 1.0])
GREY, RED = np.full(3, 0.5), np.array([0.8, 0.1, 0.1])
CUT = SECTION * shaded(GREY, UP)
TURN = trimesh.transformations.rotation_matrix(0.7, [0.3, -0.5, 0.8])
PITCH = 0.02


def picture(*meshes: Mesh, view: View = MAP) -> np.ndarray:
    """Returns 4 x 4 m around the origin, [200, 200, 4]."""
    return draw_meshes(view, meshes, np.full(2, -2.0), PITCH, np.full(2, 200))


def places() -> np.ndarray:
    """Returns where the pixels of a map are, [200, 200, 2] metres."""
    x, y = (-2 + PITCH * (np.arange(200) + part) for part in (0.3127, 0.6713))
    return np.stack(np.meshgrid(x, y), -1)


def is_like(pixels: np.ndarray, colour: np.ndarray) -> np.ndarray:
    return np.all(np.isclose(pixels[..., :3], colour, atol=1e-9), axis=-1)


@pytest.mark.parametrize("first", [0, 1])
def test_the_nearer_of_two_meshes_is_seen_whichever_is_drawn_first(first: int) -> None:
    low = Mesh(box(bounds=[[-1, -1, 0], [1, 1, 1]]).triangles, GREY)
    high = Mesh(box(bounds=[[0, 0, 1.05], [1.5, 1.5, 1.1]]).triangles, RED)
    both = [low, high]
    drawn = picture(both[first], both[1 - first])
    x, y = np.moveaxis(places(), -1, 0)
    over, under = (x > 0) & (x < 1.5) & (y > 0) & (y < 1.5), (np.abs(x) < 1) & (np.abs(y) < 1)
    assert np.array_equal(drawn[..., 3] > 0, over | under)
    inner = (x > 0.1) & (x < 0.9) & (y > 0.1) & (y < 0.9)
    assert is_like(drawn[inner], shaded(RED, UP)).all()
    assert is_like(drawn[(np.abs(x) < 0.9) & (np.abs(y) < 0.9) & (x < -0.1)], shaded(GREY, UP)).all()


def is_within(convex: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Returns which points [..., 3] are within a convex mesh."""
    offsets = np.sum(convex.face_normals * convex.triangles[:, 0], axis=1)
    return (points @ convex.face_normals.T < offsets).all(-1)


@pytest.mark.parametrize("height", [-0.31, 0.02, 0.4])
def test_where_a_mesh_is_cut_its_inside_is_seen_however_its_parts_overlap(height: float) -> None:
    parts = [icosphere(2, 0.8), box([2.6, 0.3, 0.9]), box([1, 1, 3]).apply_translation([0.9, 0.9, 0])]
    hollow = box([0.7, 0.7, 2]).apply_translation([0.9, 0.9, 0])
    for part in (*parts, hollow):
        part.apply_transform(TURN)
    points = np.concatenate([places(), np.full((200, 200, 1), height)], axis=-1)
    counts = sum(is_within(part, points).astype(int) for part in parts) - is_within(hollow, points)
    triangles = np.concatenate([*(part.triangles for part in parts), hollow.triangles[:, ::-1]])
    drawn = picture(Mesh(triangles, GREY, cuts=((UP, height),)))
    section = is_like(drawn, CUT) | is_like(drawn, EDGE * CUT)
    assert 0.05 < (counts > 0).mean() < 0.5
    np.testing.assert_array_equal(section, counts > 0)


@pytest.mark.parametrize("view", [MAP, OBLIQUE])
def test_no_pixel_of_a_closed_mesh_falls_between_its_triangles(view: View) -> None:
    ball = icosphere(4, 1.5)
    drawn = picture(Mesh(ball.triangles, GREY, cuts=((UP, 1.6),)), view=view)
    away = np.linalg.norm(places(), axis=-1)
    assert (drawn[away < 1.48, 3] == 1).all() and (drawn[away > 1.52, 3] == 0).all()
    assert not is_like(drawn, CUT).any()


def test_a_surface_has_no_inside() -> None:
    shell = Mesh(box([2, 2, 1]).triangles, GREY, is_closed=False, cuts=((UP, 0.0),))
    drawn = picture(shell)
    assert not is_like(drawn, CUT).any() and is_like(drawn[60:140, 60:140], shaded(GREY, UP)).all()


@pytest.mark.whole
def test_a_map_of_a_hall_shows_its_walls_cut_and_its_floor_pale(roofed: Scene) -> None:
    (mesh,) = make_cutaway(roofed, MAP).meshes
    drawn = draw_meshes(MAP, [mesh], np.array([1.0, 0.0]), 0.05, np.array([360, 200]))
    wall, floor = drawn[100, 24], drawn[100, 180]  # x of 2.2 and 10 m
    assert is_like(wall, SECTION * shaded(mesh.colour, UP)) and is_like(floor, pale(shaded(mesh.colour, UP)))


@pytest.mark.whole
def test_a_map_shows_what_stands_on_a_floor_that_is_part_of_the_mesh(tmp_path: Path) -> None:
    """As in a scan without a roof: walls and a table of the same mesh as the floor."""
    floor = box(bounds=[[0, 0, 0], [12, 8, 0.2]])
    parts = [
        box(bounds=[[0, 0, 0], [0.4, 8, 3]]),
        box(bounds=[[6, 0, 0], [6.4, 5, 3]]),
        box(bounds=[[9, 2, 0], [11, 3, 1]]),
    ]
    mesh = trimesh.util.concatenate([floor, *parts])
    assert isinstance(mesh, trimesh.Trimesh)
    scene = load_scene(mesh_world(tmp_path, '<geom type="mesh" mesh="scan"/>', scan=(mesh.vertices, mesh.faces)))
    above = make_cutaway(scene, MAP)
    assert above.note == "a mesh's own floor is pale" and not make_cutaway(scene, OBLIQUE).note
    (drawn,) = above.meshes
    picture = draw_meshes(MAP, [drawn], np.zeros(2), 0.1, np.array([120, 80]))
    grey = shaded(drawn.colour, UP)
    for x, y, is_floor in ((3, 6, True), (8, 6, True), (0.2, 4, False), (6.2, 3, False), (10, 2.5, False)):
        assert is_like(picture[int(10 * y), int(10 * x)], pale(grey) if is_floor else grey)


@pytest.mark.parametrize("mesh", [box(bounds=[[0, 0, 0], [4, 4, 0.5]]), icosphere(3, 1.5)], ids=["a slab", "a ball"])
def test_a_mesh_without_a_floor_of_its_own_is_drawn_as_it_is(mesh: trimesh.Trimesh) -> None:
    assert floor_of(Mesh(np.asarray(mesh.triangles), GREY), -1.0, 1.0) is None


@pytest.mark.whole
def test_a_view_from_beside_goes_through_the_near_wall_alone(roofed: Scene) -> None:
    (mesh,) = make_cutaway(roofed, OBLIQUE).meshes
    near = [normal @ OBLIQUE.towards > 0 for normal, _ in mesh.cuts]
    assert len(near) == 3 and all(near)
    room = dataclasses.replace(roofed, start=np.array([1.0, 5.0, 2.5]), goal=np.array([19.0, 5.0, 3.0]))
    assert make_cutaway(room, OBLIQUE).meshes[0].cuts == ()


@pytest.mark.whole
def test_what_is_drawn_of_a_mesh_is_what_the_axes_show(roofed: Scene) -> None:
    axes = Figure().add_subplot()
    plot_stage(axes, OBLIQUE, roofed, 2.0)
    (image,) = axes.images
    x0, x1, y0, y1 = image.get_extent()
    top = OBLIQUE.project(np.array([2.0, 9.0, 4.0]))[1]
    assert y1 == pytest.approx(top, abs=0.05) and axes.get_ylim()[1] > y1 and axes.get_xlim()[0] < x0 < x1
    flat = Figure().add_subplot()
    draw_map(flat, roofed)
    assert len(flat.images) == 1


def test_a_convex_mesh_of_few_faces_is_a_solid_and_another_a_mesh(roofed: Scene) -> None:
    ((kind, shape),) = list(standing_rows(roofed))
    mesh = mesh_of_shape(kind, shape)
    assert mesh is not None and mesh.is_closed and len(mesh.corners) == 24
    np.testing.assert_allclose(mesh.corners.reshape(-1, 3).min(0), [2, 1, 0.5], atol=1e-6)
