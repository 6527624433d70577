"""Meshes, height fields and ellipsoids on bodies that move: where they are felt, seen and touched."""

from __future__ import annotations

import re
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from edqn_jax.config import CameraConfig
from edqn_jax.sim.camera import camera, native
from edqn_jax.sim.scene import mjcf
from edqn_jax.sim.scene.distance import path_contact, signed_distance
from edqn_jax.sim.scene.scene import Scene, has_motion, scene_at, stack_scenes, take_scene
from edqn_jax.sim.scene.shapes import field_rays
from edqn_jax.sim.scene.shapes.field import SLACK_M
from tests.oracles.moved_mesh import MovedMesh
from tests.support.marks import in_whole
from tests.support.meshes import bracket, mesh_asset

RADIUS = 0.36
PHASES = (Phase.explicit, Phase.reuse, Phase.generate)  # to shrink an example would take minutes
CONFIG = CameraConfig(width=16, height=12)
VERTICES, FACES = bracket()
LOW, HIGH = np.array([6.0, 2.0, 3.0]), np.array([14.0, 8.0, 7.0])
WORLD = """
<mujoco>
  <custom><text name="motion:b" data="{motion}"/></custom>
  <asset>{mesh}</asset>
  <worldbody>
    <site name="start" pos="1 5 5"/><site name="goal" pos="19 5 5"/>
    <site name="volume" type="box" pos="10 5 5" size="10 5 5" group="3"/>
    <body name="b" mocap="true" pos="{position}" quat="{quaternion}"><geom name="m" type="mesh" mesh="m"/></body>
  </worldbody>
</mujoco>
"""


def text_of(numbers: Any) -> str:
    return " ".join(f"{number:.9g}" for number in np.ravel(numbers))


def world_of(folder: Path, mesh: MovedMesh) -> Scene:
    """The scene of a file that says how the mesh moves."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, mesh.rotation.ravel())
    words = f"ellipse {text_of(mesh.half_axes)} {mesh.rate:.9g} {mesh.phase:.9g}"
    if any(mesh.velocity):
        words += f"; bounce {text_of([*mesh.velocity, *mesh.low, *mesh.high])}"
    file = folder / "moving.xml"
    places = {"position": text_of(mesh.position), "quaternion": text_of(quaternion)}
    file.write_text(WORLD.format(motion=words, mesh=mesh_asset("m", VERTICES, FACES), **places))
    return mjcf.load_scene(file)


def moved_mesh(quaternion: Any, position: Any, velocity: Any, half_axes: Any, rate: float, phase: float) -> MovedMesh:
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(quaternion, float) / np.linalg.norm(quaternion))
    place = LOW + np.asarray(position) * (HIGH - LOW)
    turn, axes = rotation.reshape(3, 3), np.reshape(half_axes, (2, 3))
    return MovedMesh(VERTICES[FACES], turn, place, velocity, LOW, HIGH, axes, rate, phase)


def drawn_mesh(rng: np.random.Generator) -> MovedMesh:
    quaternion, position = rng.normal(size=4), rng.uniform(size=3)
    return moved_mesh(quaternion, position, tuple(rng.uniform(-2, 2, 3)), rng.uniform(-1, 1, 6), 1.3, 0.4)


def numbers(low: float, high: float, count: int) -> st.SearchStrategy[tuple[float, ...]]:
    return st.tuples(*[st.floats(low, high)] * count)


MESHES = st.builds(
    moved_mesh,
    quaternion=numbers(-1, 1, 4).filter(lambda each: np.linalg.norm(each) > 0.2),
    position=numbers(0, 1, 3),
    velocity=numbers(-2, 2, 3),
    half_axes=numbers(-1.5, 1.5, 6),
    rate=st.floats(-2, 2),
    phase=st.floats(-3, 3),
)


@jax.jit
def distances_at(scene: Scene, points: Any, time: Any) -> Any:
    return jax.vmap(partial(signed_distance, scene_at(scene, time)))(points)


@settings(max_examples=25, deadline=None, phases=PHASES)
@given(mesh=MESHES, time=st.floats(0.0, 30.0, width=32), seed=st.integers(0, 2**16))
def test_a_mesh_that_is_turned_and_moves_is_where_its_triangles_are(
    tmp_path_factory: pytest.TempPathFactory, mesh: MovedMesh, time: float, seed: int
) -> None:
    scene = world_of(tmp_path_factory.mktemp("moving"), mesh)
    near = np.random.default_rng(seed).uniform(-1.8, 1.8, (60, 3))
    points = (mesh.place(time) + near).astype(np.float32)
    ours, theirs = np.asarray(distances_at(scene, points, jnp.float32(time))), mesh.distances(points, time)
    there = (theirs > 0.01) & (theirs < 0.5)
    # Float32: 30 s at 2 m/s.
    assert np.all(ours[there] - theirs[there] < 0.011) and np.all(theirs[there] - ours[there] < SLACK_M)
    assert np.all(ours[theirs >= 0.5] - theirs[theirs >= 0.5] < 0.011) and np.all(ours[theirs < -0.05] < 0)


def depths_by(in_c: bool) -> Any:
    """The camera's depths at a time, of rays in C or in JAX."""

    @jax.jit
    def depths(scene: Scene, position: Any, time: Any) -> Any:
        return camera.render_depth(CONFIG, scene_at(scene, time), position, jnp.eye(3))

    def call(*given: Any) -> Any:
        with pytest.MonkeyPatch.context() as patch:  # also while the program is lowered, which draws
            if not in_c:
                patch.setattr(field_rays, "is_available", lambda platform: False)
                patch.setattr(native, "is_available", lambda platform: False)
            lowered = depths.lower(*given)
            assert ("edqn_" in lowered.as_text()) == (in_c and shutil.which("cc") is not None)
            return lowered.compile()(*given)

    return call


DEPTHS = {in_c: depths_by(in_c) for in_c in (True, False)}


def rays_of_camera() -> np.ndarray:
    """Unit vectors [H * W, 3] along the middle rays of a camera that looks along x."""
    half = np.tan(np.radians(CONFIG.horizontal_fov_deg) / 2)
    left = half * (1 - 2 * (np.arange(CONFIG.width) + 0.5) / CONFIG.width)
    up = half * CONFIG.height / CONFIG.width * (1 - 2 * (np.arange(CONFIG.height) + 0.5) / CONFIG.height)
    rays = np.stack([np.ones((CONFIG.height, CONFIG.width)), *np.meshgrid(left, up)], axis=-1).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@pytest.mark.parametrize("in_c", [True, *in_whole(False)])
@settings(max_examples=10, deadline=None, phases=PHASES)
@given(mesh=MESHES, time=st.floats(0.0, 30.0, width=32))
def test_the_camera_sees_it_where_its_triangles_are(
    tmp_path_factory: pytest.TempPathFactory, in_c: bool, mesh: MovedMesh, time: float
) -> None:
    scene = world_of(tmp_path_factory.mktemp("moving"), mesh)
    eye, rays = (mesh.place(time) - [3.0, 0.3, 0.2]).astype(np.float32), rays_of_camera()
    ours = np.asarray(DEPTHS[in_c](scene, eye, jnp.float32(time))).ravel()
    theirs = mesh.ray_depths(eye, rays, time)
    met = np.isfinite(ours)
    # No ray passes a triangle, and none ends further from all of them than distances may be too small.
    assert np.isfinite(theirs).sum() >= 4 and np.all(ours <= theirs + 0.03)
    assert np.all(mesh.distances(eye + ours[met, None] * rays[met], time) < SLACK_M)


@jax.jit
def contact_of(scene: Scene, path: Any, times: Any) -> Any:
    return path_contact(scene, path, RADIUS, times)


def gaps_along(mesh: MovedMesh, path: np.ndarray, times: np.ndarray, each: int) -> np.ndarray:
    """Metres between body and triangles at `each` moments of every segment."""
    segments, moments = np.arange(len(path)), np.arange((len(path) - 1) * each + 1) / each
    points = np.stack([np.interp(moments, segments, path[:, axis]) for axis in range(3)], axis=1)
    when = np.interp(moments, segments, times)
    gaps = [mesh.distances(point[None], float(time))[0] for point, time in zip(points, when, strict=True)]
    return np.array(gaps) - RADIUS


@pytest.mark.whole
@pytest.mark.parametrize(("flights", "least"), [(12, 1), pytest.param(30, 5, marks=pytest.mark.whole)])
def test_what_it_runs_into_is_touched_when_its_triangles_touch_it(flights: int, least: int, tmp_path: Path) -> None:
    rng, each = np.random.default_rng(0), 8
    touched = free = 0
    for _ in range(flights):
        mesh = drawn_mesh(rng)
        scene = world_of(tmp_path, mesh)
        times = (rng.uniform(0, 9) + 0.02 * np.arange(14)).astype(np.float32)
        way = rng.normal(size=3)
        way = way / np.linalg.norm(way)
        begin = mesh.place(float(times[0])) + rng.uniform(1.0, 1.7) * way
        path = (begin + np.arange(14)[:, None] * 0.02 * (rng.uniform(-3, 3, 3) - way)).astype(np.float32)
        gaps = gaps_along(mesh, path, times, each)
        if gaps[0] < SLACK_M:
            continue
        touch, fraction = map(np.asarray, contact_of(scene, path, times))
        free += not touch.any()
        # Distances are never too large by more than a centimetre.
        late = np.flatnonzero(gaps < -0.015) / each
        assert touch.any() or not len(late), gaps.min()
        if touch.any():
            stated = np.argmax(touch) + fraction[np.argmax(touch)]
            assert np.interp(stated * each, np.arange(len(gaps)), gaps) < SLACK_M
            assert not len(late) or stated < late[0] + 0.2, (stated, late[0])
            touched += len(late) > 0
    assert touched >= least and free >= least, (touched, free)


def test_what_is_written_moves_alike_and_so_does_a_pool_of_worlds(tmp_path: Path) -> None:
    mesh = drawn_mesh(np.random.default_rng(1))
    scene = world_of(tmp_path, mesh)
    mjcf.write_scene(scene, tmp_path / "again.xml")
    still = re.sub('<text .*/>|mocap="true"', "", (tmp_path / "again.xml").read_text())
    (tmp_path / "still.xml").write_text(still)
    again, resting = mjcf.load_scene(tmp_path / "again.xml"), mjcf.load_scene(tmp_path / "still.xml")
    pool = stack_scenes([resting, scene])
    points = (mesh.position + np.random.default_rng(2).uniform(-3, 3, (80, 3))).astype(np.float32)
    for time in (0.0, 1.7, 8.0):
        expected = np.asarray(distances_at(scene, points, jnp.float32(time)))
        for other in (again, take_scene(pool, 1)):
            np.testing.assert_allclose(distances_at(other, points, jnp.float32(time)), expected, atol=2e-4)
        np.testing.assert_allclose(
            distances_at(take_scene(pool, 0), points, jnp.float32(time)),
            distances_at(scene, points, jnp.float32(0.0)),
            atol=2e-4,
        )
    assert np.abs(np.asarray(distances_at(again, points, jnp.float32(1.7))) - expected).max() > 0.3
    assert has_motion(again) and not has_motion(resting)


def test_a_mesh_that_bounces_in_the_volume_turns_back_where_its_box_ends(tmp_path: Path) -> None:
    file = tmp_path / "bounces.xml"
    mesh = mesh_asset("m", VERTICES, FACES)
    file.write_text(WORLD.format(motion="bounce 4 0 0", mesh=mesh, position="10 5 5", quaternion="1 0 0 1"))
    scene, times = mjcf.load_scene(file), np.linspace(0, 40, 400, dtype=np.float32)
    x = np.asarray(jax.vmap(lambda time: scene_at(scene, time).others["fields"].position[0, 0])(times))
    corners = (VERTICES @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]))[:, 0]  # a quarter turn about z
    half = (corners.max() - corners.min()) / 2
    assert abs(x.min() - half) < 0.06 and abs(x.max() - (20 - half)) < 0.06


@pytest.mark.whole
def test_height_fields_and_ellipsoids_move_with_what_else_a_body_holds(tmp_path: Path) -> None:
    file = tmp_path / "cart.xml"
    file.write_text(
        '<mujoco><custom><text name="motion:cart" data="oscillate 0 3 0 4 0"/></custom>'
        '<asset><hfield name="h" nrow="2" ncol="3" size="1 1 0.6 0.2" elevation="0 1 0 0 1 0"/></asset><worldbody>'
        '<site name="volume" type="box" pos="10 5 5" size="10 5 5" group="3"/><site name="start" pos="1 5 5"/>'
        '<body name="cart" mocap="true" pos="10 5 3" euler="0 0 30"><geom type="hfield" hfield="h"/>'
        '<body pos="0 0 2"><geom type="ellipsoid" size=".5 .8 .4"/><geom type="box" size=".2 .2 .2" pos="0 0 1"/>'
        "</body></body></worldbody></mujoco>"
    )
    scene = mjcf.load_scene(file)
    points = np.random.default_rng(0).uniform((8, 3, 2), (12, 7, 7), (200, 3)).astype(np.float32)
    still = np.asarray(distances_at(scene, points, jnp.float32(0.0)))
    moved = np.asarray(distances_at(scene, points + np.array([0, 3, 0], np.float32), jnp.float32(1.0)))
    np.testing.assert_allclose(moved, still, atol=2e-4)
    assert np.abs(np.asarray(distances_at(scene, points, jnp.float32(1.0))) - still).max() > 1
