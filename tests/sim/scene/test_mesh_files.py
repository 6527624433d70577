"""Meshes and height fields in files of their own, and ellipsoids: what they become, and what is refused."""

from __future__ import annotations

import struct
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh

from edqn_jax.config import Config, WorldConfig
from edqn_jax.errors import ConfigError
from edqn_jax.runs.world_copy import copy_worlds, with_copied_worlds
from edqn_jax.sim.scene.distance import shape_distances
from edqn_jax.sim.scene.mjcf import SceneError, load_world, mjcf_of
from edqn_jax.sim.scene.mjcf_parts.assets import load_geometry
from edqn_jax.sim.scene.mjcf_parts.files import load_checked_text

RING = trimesh.creation.torus(1, 0.3, major_sections=16, minor_sections=8)
SITES = (
    '<site name="start" pos="1 5 6"/><site name="goal" pos="19 5 6"/>'
    '<site name="volume" type="box" pos="10 5 4" size="10 5 4" group="3"/>'
)
HEIGHTS = np.random.default_rng(0).uniform(0, 1, (4, 6))


def world(folder: Path, assets: str, geoms: str, compiler: str = "") -> Path:
    file = folder / "world.xml"
    file.write_text(
        f"<mujoco>{compiler}<asset>{assets}</asset><worldbody>{SITES}{geoms}</worldbody></mujoco>", encoding="utf-8"
    )
    return file


def rays_down(file: Path, count: int = 150) -> tuple[np.ndarray, np.ndarray]:
    """Points [P, 3] where MuJoCo's rays from above meet a world, and the numbers of the geoms there."""
    model = mujoco.MjModel.from_xml_string(load_checked_text(file))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    points, geoms = [], []
    for x, y in np.random.default_rng(1).uniform((2, 1), (18, 9), (count, 2)):
        geom = np.zeros(1, np.int32)
        there = mujoco.mj_ray(model, data, np.array([x, y, 20.0]), np.array([0, 0, -1.0]), None, 1, -1, geom)
        if there > 0:
            points.append([x, y, 20 - there])
            geoms.append(geom[0])
    return np.array(points), np.array(geoms)


@pytest.mark.whole
@pytest.mark.slow
def test_what_mujoco_sees_of_files_ellipsoids_and_height_fields_is_the_surface_of_fields(tmp_path: Path) -> None:
    folder = tmp_path / "meshes"
    folder.mkdir()
    for kind in ("obj", "stl", "ply"):
        RING.export(folder / f"ring.{kind}")
    elevation = " ".join(f"{height:.6g}" for height in HEIGHTS.ravel())
    file = world(
        tmp_path,
        '<mesh name="a" file="ring.stl" scale="1 1 2" refpos=".2 0 0"/><mesh name="b" file="ring.ply"/>'
        '<mesh file="ring.obj" refquat=".9 .1 0 0"/>'
        f'<hfield name="h" nrow="4" ncol="6" size="8 4 1.5 .5" elevation="{elevation}"/>',
        '<geom type="mesh" mesh="a" pos="4 5 4" euler="30 0 0"/><geom type="mesh" mesh="b" pos="8 5 4"/>'
        '<geom type="mesh" mesh="ring" pos="12 5 4"/>'
        '<geom type="ellipsoid" size="1.5 1 .5" pos="16 5 4" euler="0 20 0"/>'
        '<geom name="land" type="hfield" hfield="h" pos="10 5 .5" euler="0 0 10"/>',
        '<compiler meshdir="meshes"/>',
    )
    loaded = load_world(file)
    assert len(loaded.names["fields"]) == 5 and loaded.names["fields"][-1] == "land"
    points, geoms = rays_down(file)
    assert set(geoms) == set(range(5))
    found = jax.jit(jax.vmap(lambda point: shape_distances(loaded.scene, point)["fields"]))
    distances = np.asarray(found(jnp.asarray(points, jnp.float32)))[np.arange(len(geoms)), geoms]
    assert distances.max() < 0.005 and distances.min() > -0.05


@pytest.mark.parametrize("kind", ["png", "bin"])
def test_the_file_of_a_height_field_is_the_one_that_mujoco_reads(tmp_path: Path, kind: str) -> None:
    levels = np.round(255 * HEIGHTS).astype(np.uint8)
    if kind == "png":
        from PIL import Image

        Image.fromarray(levels).save(tmp_path / "land.png")
    else:
        (tmp_path / "land.bin").write_bytes(struct.pack("<2i", 4, 6) + levels.astype("<f4").tobytes())
    asset = f'<hfield name="h" file="land.{kind}" size="8 4 1.5 .5"/>'
    file = world(tmp_path, asset, '<geom type="hfield" hfield="h" pos="10 5 .5"/>')
    theirs = mujoco.MjModel.from_xml_string(
        file.read_text(), {f"land.{kind}": (tmp_path / f"land.{kind}").read_bytes()}
    )
    ours = mujoco.MjModel.from_xml_string(load_checked_text(file))
    np.testing.assert_allclose(ours.hfield_data, theirs.hfield_data, atol=1e-6)


def test_a_run_keeps_a_copy_that_needs_no_other_file(tmp_path: Path) -> None:
    RING.export(tmp_path / "ring.stl")
    file = world(tmp_path, '<mesh name="a" file="ring.stl"/>', '<geom type="mesh" mesh="a" pos="9 5 4"/>')
    run = tmp_path / "run"
    run.mkdir()
    config = Config(world=WorldConfig(name=str(file)))
    copy_worlds(run, config)
    assert with_copied_worlds(run, config) == (config, [])
    before = load_world(file)
    RING.copy().apply_scale(1.1).export(tmp_path / "ring.stl")
    changed, (note,) = with_copied_worlds(run, config)
    assert "has changed since the run began" in note
    (tmp_path / "ring.stl").unlink()
    copy = load_world(changed.world.name)
    assert mjcf_of(copy.scene) == mjcf_of(before.scene)


def msh_of(mesh: trimesh.Trimesh) -> bytes:
    """A mesh in MuJoCo's own binary form, with a place on a texture for each vertex."""
    counts = struct.pack("<4i", len(mesh.vertices), 0, len(mesh.vertices), len(mesh.faces))
    parts = mesh.vertices.astype("<f4"), mesh.vertices[:, :2].astype("<f4"), mesh.faces.astype("<i4")
    return counts + b"".join(part.tobytes() for part in parts)


def test_a_mesh_of_mujocos_own_form_is_the_one_that_mujoco_reads(tmp_path: Path) -> None:
    (tmp_path / "ring.msh").write_bytes(msh_of(RING))
    file = world(tmp_path, '<mesh name="a" file="ring.msh"/>', '<geom type="mesh" mesh="a" pos="10 5 4"/>')
    theirs = mujoco.MjModel.from_xml_path(str(file))
    ours = mujoco.MjModel.from_xml_string(load_checked_text(file))
    assert theirs.nmeshface == ours.nmeshface == len(RING.faces)
    np.testing.assert_allclose(ours.geom_pos, theirs.geom_pos, atol=1e-6)
    np.testing.assert_allclose(np.ptp(ours.mesh_vert, axis=0), np.ptp(theirs.mesh_vert, axis=0), atol=1e-5)


def stl_of(count: int) -> bytes:
    """The beginning of a file that says that it has so many triangles."""
    return b"\0" * 80 + struct.pack("<I", count)


def ply_of(vertices: list[list[float]], faces: list[list[int]]) -> bytes:
    """A mesh as a .ply, whatever its triangles name."""
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    places = b"".join(struct.pack("<3f", *vertex) for vertex in vertices)
    return head.encode() + places + b"".join(struct.pack("<B3i", 3, *face) for face in faces)


BAD = {
    "../ring.stl": "which lies outside of the world's folder; copy it there",
    "/etc/hostname": "which lies outside of the world's folder",
    "link.stl": "which lies outside of the world's folder",
    "none.stl": "and there is none in",
    "ring.glb": r"must end in .obj, .stl, .ply, .msh",
    "short.msh": "cannot be read as .msh: its length is not that of what it counts",
    "empty.msh": "cannot be read as .msh",
    "wrong.msh": "has a triangle of vertices that it does not have",
    "large.ply": "has 10,000,000 triangles; it may have 500,000, so thin it out",
    "large.stl": "names files of more than 100,000,000 bytes together",
    "nan.obj": "has a vertex that is not finite",
    "points.ply": "has no triangles; `edqn world` makes a world of points",
    "broken.ply": "cannot be read as .ply",
    "outside.ply": "has a triangle of vertices that it does not have",
    "before.ply": "has a triangle of vertices that it does not have",
    "far.obj": r"has a vertex 1e\+30 away; mend it, or scale it",
    "open.stl": "geom 'thing': the mesh is not watertight.*give it a thickness: <numeric",
    "turned.stl": "geom 'thing': the mesh is inside out",
}


@pytest.mark.parametrize(("name", "says"), BAD.items())
def test_a_file_that_cannot_be_flown_is_refused_in_one_sentence(tmp_path: Path, name: str, says: str) -> None:
    home = tmp_path / "home"
    home.mkdir()
    RING.export(tmp_path / "ring.stl")
    (home / "link.stl").symlink_to(tmp_path / "ring.stl")
    RING.export(home / "ring.glb")
    (home / "large.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nelement face 10000000\n")
    (home / "short.msh").write_bytes(msh_of(RING)[:-1])
    (home / "empty.msh").write_bytes(b"")
    (home / "wrong.msh").write_bytes(msh_of(RING)[:-4] + struct.pack("<i", len(RING.vertices)))
    with (home / "large.stl").open("wb") as large:
        large.write(stl_of(10_000_000))
        large.truncate(500_000_084)  # no byte of it is on the disk
    (home / "nan.obj").write_text("v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n")
    (home / "far.obj").write_text("v 0 0 0\nv 1e30 0 0\nv 0 1 0\nf 1 2 3\n")
    for name_, corner in (("outside", 99_999), ("before", -5)):
        vertices, faces = RING.vertices.tolist(), [*RING.faces.tolist(), [0, 1, corner]]
        (home / f"{name_}.ply").write_bytes(ply_of(vertices, faces))
    trimesh.PointCloud(RING.vertices).export(home / "points.ply")
    (home / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n1\n")
    trimesh.Trimesh(RING.vertices, RING.faces[1:]).export(home / "open.stl")
    trimesh.Trimesh(RING.vertices, RING.faces[:, ::-1]).export(home / "turned.stl")
    file = world(home, f'<mesh name="m" file="{name}"/>', '<geom name="thing" type="mesh" mesh="m" pos="9 5 4"/>')
    before = sorted(home.iterdir())
    with pytest.raises(SceneError, match=says) as raised:
        load_world(file)
    assert "\n" not in str(raised.value) and sorted(home.iterdir()) == before


def test_a_text_with_its_meshes_may_not_be_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    RING.export(tmp_path / "ring.stl")
    file = world(tmp_path, '<mesh name="a" file="ring.stl"/>', '<geom type="mesh" mesh="a" pos="9 5 4"/>')
    monkeypatch.setattr("edqn_jax.sim.scene.mjcf_parts.files.MAX_BYTES", 2000)
    with pytest.raises(SceneError, match="with the files that it names; a world may have 2,000"):
        load_world(file)


def picture_of(columns: int, rows: int) -> bytes:
    """The beginning of a .png that says that it is so large."""
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4s2I", 13, b"IHDR", columns, rows)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("land.png", picture_of(12_000, 10_000), "is of 10000 x 12000; it must be 2 x 2 to 250,000 heights"),
        ("land.png", picture_of(0, 0), "is of 0 x 0; it must be"),
        ("land.bin", struct.pack("<2i", 100_000, 100_000), "is of 100000 x 100000; it must be"),
        ("land.bin", struct.pack("<2i", -4, -4) + bytes(64), "is of -4 x -4; it must be"),
        ("land.bin", b"", "is of 0 x 0; it must be"),
        ("land.bin", struct.pack("<2i4f", 2, 2, 0, np.nan, 1, 0), "has a vertex that is not finite"),
        ("land.bin", struct.pack("<2i3f", 2, 2, 0, 1, 0), "cannot be read: Error: unexpected file size"),
    ],
)
def test_the_file_of_a_height_field_is_refused_by_what_it_says_before_it_is_unpacked(
    tmp_path: Path, name: str, content: bytes, says: str
) -> None:
    (tmp_path / name).write_bytes(content)
    asset = f'<hfield name="h" file="{name}" size="8 4 1.5 .5"/>'
    with pytest.raises(SceneError, match=says) as raised:
        load_world(world(tmp_path, asset, '<geom name="land" type="hfield" hfield="h" pos="10 5 .5"/>'))
    assert "\n" not in str(raised.value)


def instances(count: int) -> bytes:
    """A .glb that holds one mesh many times."""
    scene = trimesh.Scene()
    for number in range(count):
        scene.add_geometry(RING, node_name=f"{number}", geom_name="ring")
    return scene.export(file_type="glb")  # pyright: ignore[reportReturnType]


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        ("obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + 1024 * b"f 1 2 3\n"),
        ("stl", b"solid\n" + 1024 * b"facet\nouter loop\nendloop\nendfacet\n"),
        ("glb", instances(4)),
    ],
)
def test_triangles_are_counted_before_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, content: bytes
) -> None:
    assert len(RING.faces) == 256
    (tmp_path / f"many.{kind}").write_bytes(content)
    monkeypatch.setattr("trimesh.load", lambda *_, **__: pytest.fail("it is read"))
    with pytest.raises(ConfigError, match="has 1,024 triangles; it may have 1,023"):
        load_geometry(tmp_path / f"many.{kind}", kind, 1023)


@pytest.mark.parametrize(
    ("far", "refused"), [("1e7", True), ("-123456789.5", True), ("3E+30", True), ("9999.5", False)]
)
def test_a_vertex_in_a_world_may_not_be_so_far_away_that_mujoco_complains(
    tmp_path: Path, far: str, refused: bool
) -> None:
    numbers = f"0.12345678901 0 0  1e-10 1 0  0 0 1  {far} 0 0"
    asset = f'<mesh name="m" vertex="{numbers}" face="0 2 1 0 1 3 1 2 3 0 3 2"/>'
    file = world(tmp_path, asset, '<geom type="box" size="1 1 1" pos="9 5 1"/>')
    if not refused:
        assert far in load_checked_text(file)
        return
    with pytest.raises(SceneError, match=r"<mesh name='m'> with a vertex 1e\+07 or more away; scale it"):
        load_checked_text(file)
