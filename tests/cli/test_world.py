"""`edqn world`: worlds of meshes and clouds of points, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from edqn_jax.cli import main
from edqn_jax.devices import devices
from edqn_jax.sim.scene.mjcf import check_scene, load_world, mjcf_of
from edqn_jax.sim.scene.scans import scan
from edqn_jax.sim.scene.scans.point_files import read_points
from tests.support.marks import in_whole
from tests.support.octomaps import octomap_of

ROOM = (8.0, 5.0, 3.0)


def room() -> trimesh.Trimesh:
    """A closed room with walls of 0.2 m and a pillar, its corner at 5 5 5."""
    outer = trimesh.creation.box(bounds=[[0, 0, 0], ROOM])
    inner = trimesh.creation.box(bounds=[[0.2] * 3, [side - 0.2 for side in ROOM]])
    pillar = trimesh.creation.box(bounds=[[4.0, 2.0, 0.1], [4.4, 2.4, 2.9]])
    inner.invert()
    parts = [outer, inner, pillar]
    vertices = np.concatenate([part.vertices for part in parts]) + 5.0
    return trimesh.Trimesh(
        vertices, np.concatenate([part.faces + 8 * i for i, part in enumerate(parts)]), process=False
    )


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing that a test makes lands in the repository; the devices are those of the tests."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(devices, "use_cpu_devices", lambda count=None: None)


def flown_inside(folder: str) -> None:
    """The world can be flown from end to end within the room."""
    loaded = load_world(Path(folder) / "world.xml")
    assert loaded.names["fields"] == ("scan",) and loaded.names["planes"] == ("ground",)
    check_scene(loaded.scene, 0.36, goal_radius=2.0)
    ends = np.stack([loaded.scene.start, loaded.scene.goal])
    assert np.all(ends > 0.5) and np.all(ends < np.subtract(ROOM, 0.5))


def test_a_closed_mesh_is_a_world(capsys: pytest.CaptureFixture[str]) -> None:
    room().export("room.ply")
    assert main(["world", "room.ply", "--out", "here"]) == 0
    said = capsys.readouterr().out
    assert "36 triangles, 8.0 × 5.0 × 3.0 m, distances on cells of 0.1 m" in said
    assert "edqn check here/world.xml" in said
    assert sorted(file.name for file in Path("here").iterdir()) == ["scan.obj", "world.xml"]
    flown_inside("here")


@pytest.mark.parametrize("kind", ["glb", *in_whole("stl")])
def test_scale_and_the_axis_that_points_up_are_taken(kind: str) -> None:
    mesh = room()
    mesh.apply_scale(1000)
    if kind == "glb":  # y up, as the format has it
        mesh.vertices = mesh.vertices[:, [1, 2, 0]]
    mesh.export(f"room.{kind}")
    assert main(["world", f"room.{kind}", "--out", "here", "--scale", ".001"]) == 0
    flown_inside("here")


@pytest.mark.whole
def test_what_is_not_closed_has_a_thickness(capsys: pytest.CaptureFixture[str]) -> None:
    mesh = room()
    trimesh.Trimesh(mesh.vertices, mesh.faces[12:-1], process=False).export("open.ply")
    words = ["world", "open.ply", "--out", "here"]
    assert main(words) == 2
    assert "is not watertight" in (said := capsys.readouterr().err) and "or give --thickness, metres" in said
    assert not Path("here").exists()
    assert main([*words, "--thickness", "0.1"]) == 0
    loaded = load_world("here/world.xml")
    (grid,) = loaded.scene.others["fields"].grids
    assert grid.thickness == 0.1
    again = Path("again.xml")
    again.write_text(mjcf_of(loaded.scene))
    assert load_world(again).scene.others["fields"].grids[0].thickness == pytest.approx(0.1)


@pytest.mark.whole
@pytest.mark.slow
def test_a_cloud_of_points_has_a_thickness(capsys: pytest.CaptureFixture[str]) -> None:
    points = trimesh.sample.sample_surface(room(), 40_000, seed=1)[0]
    trimesh.PointCloud(points).export("cloud.ply")
    assert main(["world", "cloud.ply", "--out", "here"]) == 0
    assert "40,000 points, 0.1 m thick" in capsys.readouterr().out
    flown_inside("here")


def pcd(points: np.ndarray, how: str, fields: str = "x y z", count: int | None = None) -> bytes:
    """A file of the Point Cloud Library, with an intensity before its points and two bytes after them."""
    head = (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS i {fields} _ _\nSIZE 8 4 4 4 1 1\n"
        f"TYPE F F F F U U\nCOUNT 2 1 1 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(points) if count is None else count}\nDATA {how}\n"
    )
    if how != "binary":
        return (head + "\n".join(f"7 7 {x:.5f} {y:.5f} {z:.5f} 0 0" for x, y, z in points) + "\n").encode()
    row = np.dtype([("i", "<f8", 2), ("place", "<f4", 3), ("rest", "u1", 2)])
    table = np.zeros(len(points), row)
    table["place"] = points
    return head.encode() + table.tobytes()


def write_points(kind: str, points: np.ndarray) -> None:
    if kind.endswith("pcd"):
        Path(kind).write_bytes(pcd(points, kind.removesuffix(".pcd")))
    else:
        between = ", " if kind == "commas.xyz" else "  "
        rows = (between.join(f"{each:.5f}" for each in (*point, 0.5)) for point in points)
        Path(kind).write_text("# a comment\n\n" + "\n".join(rows) + "\n")


@pytest.mark.parametrize("kind", ["spaces.xyz", "commas.xyz", "ascii.pcd", "binary.pcd"])
def test_points_are_those_of_the_file(kind: str) -> None:
    points = trimesh.sample.sample_surface(room(), 4000, seed=1)[0]
    write_points(kind, points)
    np.testing.assert_allclose(read_points(Path(kind), kind[-3:], len(points)), points, atol=1e-5)


@pytest.mark.whole
@pytest.mark.parametrize("kind", ["spaces.xyz", "binary.pcd"])
def test_files_of_points_are_worlds(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    write_points(kind, trimesh.sample.sample_surface(room(), 40_000, seed=1)[0])
    assert main(["world", kind, "--out", "here"]) == 0
    assert "40,000 points, 0.1 m thick" in capsys.readouterr().out
    flown_inside("here")


FEW = np.arange(15.0).reshape(5, 3)
BAD_POINTS = {
    "empty.xyz": (b"", "'empty.xyz' is empty; a world needs points"),
    "words.xyz": (b"x y z\n1 2 3\n", "'words.xyz' is no list of points: each of its lines must begin with x y z"),
    "two.xyz": (b"1 2\n3 4\n", "'two.xyz' is no list of points"),
    "none.xyz": (b"# nothing\n", "'none.xyz' has 0 points; a world needs more"),
    "nan.xyz": (b"0 0 0\n1 0 0\nnan 1 0\n1 1 2\n", "'nan.xyz' has a point that is not finite"),
    "long.xyz": (b"1 " * 10_000, "'long.xyz' is no list of points"),
    "many.xyz": (b"1 2 3\n" * 101, "'many.xyz' may have 100 points and has more than that, so thin it out"),
    "lines.xyz": (b"\n" * 1000, "'lines.xyz' may have 100 points and has more than that"),
    "millimetres.xyz": (b"0 0 0\n5000 0 0\n0 4000 0\n0 0 3000\n", "0.001 if it is in millimetres"),
    "packed.pcd": (pcd(FEW, "binary_compressed"), "is compressed; write it as binary"),
    "other.pcd": (pcd(FEW, "base64"), "has DATA base64; it must be ascii or binary"),
    "text.pcd": (b"not a header\n" * 9, "'text.pcd' is no .pcd: a header from VERSION to DATA must come first"),
    "flat.pcd": (pcd(FEW, "ascii", "x y w"), "'flat.pcd' must have the FIELDS x, y and z, each once"),
    "sizes.pcd": (pcd(FEW, "ascii").replace(b"SIZE 8", b"SIZE 3"), "must have a SIZE, a TYPE (F, I or U) and a COUNT"),
    "short.pcd": (pcd(FEW, "binary")[:-1], "'short.pcd' says that it has 5 points, and there are others or fewer"),
    "fewer.pcd": (pcd(FEW, "ascii", count=6), "'fewer.pcd' says that it has 6 points, and there are others or fewer"),
    "count.pcd": (pcd(FEW, "ascii").replace(b"POINTS 5", b"POINTS all"), "does not say how many POINTS it has"),
    "many.pcd": (pcd(FEW, "binary", count=10**12), "'many.pcd' may have 100 points and has 1,000,000,000,000"),
    "minus.pcd": (pcd(FEW, "binary", count=-1), "'minus.pcd' says that it has -1 points"),
    "nan.pcd": (pcd(FEW * [1, np.nan, 1], "binary"), "'nan.pcd' has a point that is not finite"),
}


@pytest.mark.parametrize("name", BAD_POINTS)
def test_points_that_cannot_be_a_world_are_refused_in_a_sentence(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    content, says = BAD_POINTS[name]
    monkeypatch.setattr(scan, "MOST_READ", 100)
    Path(name).write_bytes(content)
    assert main(["world", name, "--out", "here"]) == 2
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1 and not Path("here").exists()


@pytest.mark.whole
@pytest.mark.slow
def test_an_octomap_is_a_world(capsys: pytest.CaptureFixture[str]) -> None:
    x, y, z = np.indices((80, 50, 30))
    walls = (np.minimum(x, 79 - x) < 2) | (np.minimum(y, 49 - y) < 2) | (np.minimum(z, 29 - z) < 2)
    walls |= (abs(x - 42) < 3) & (abs(y - 22) < 3)
    Path("room.bt").write_bytes(octomap_of(np.argwhere(walls) - 20, 0.1))
    assert main(["world", "room.bt", "--out", "here"]) == 0
    assert f"{walls.sum():,} voxels, 0.15 m thick" in capsys.readouterr().out
    flown_inside("here")
    grid = load_world("here/world.xml").scene.others["fields"].grids[0]
    assert grid.thickness == pytest.approx(0.15)


def test_many_triangles_are_thinned_out(monkeypatch: pytest.MonkeyPatch) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=2)
    trimesh.Trimesh(ball.vertices, ball.faces[1:]).export("ball.ply")
    monkeypatch.setattr(scan, "MOST_KEPT", 2000)
    read = scan.read_scan(Path("ball.ply"), scan.ScanOptions(thickness=0.3))
    assert 200 < len(read.faces) <= 2000
    away = np.linalg.norm(read.vertices[read.faces].mean(1) - 2, axis=1)
    assert np.abs(away - 2).max() < 0.1
    with pytest.raises(scan.ConfigError, match="even where those within 0.01 m are one"):
        scan.read_scan(Path("ball.ply"), scan.ScanOptions(thickness=0.01))


BAD = {
    "none.ply": "there is no file 'none.ply'",
    "room.fbx": "is no known scan; it must end in .ply, .stl, .obj, .glb, .bt, .xyz, .pcd",
    "empty.bt": "'empty.bt' has 0 points; a world needs more",
    "small.ply": "measures 0.8 x 0.5 x 0.3 m, too little to fly in; give --scale",
    "large.ply": "m, more than 400; give a smaller --scale, 0.001 if it is in millimetres",
    "tall.ply": "is taller than it is wide, 3 x 5 x 8 m; say which axis points up: --up y, or --up z",
    "turned.ply": "the mesh is inside out",
    "nan.obj": "has a point that is not finite",
    "sparse.ply": "m apart, and a surface of 0.1 m would have holes; give --thickness, or more points",
    "many.ply": "has 10,000,000 triangles; it may have 5,000,000",
    "vast.obj": "the mesh file 'vast.obj' has 12.0 GB; it may have 1, so simplify it",
}


@pytest.mark.parametrize(("name", "says"), BAD.items())
def test_what_cannot_be_a_world_is_refused_in_a_sentence_and_nothing_is_written(
    name: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = room()
    Path("room.fbx").write_bytes(b"")
    with Path("vast.obj").open("wb") as vast:
        vast.truncate(12_000_000_000)  # no byte of it is on the disk
    if name in ("small.ply", "large.ply"):
        mesh.apply_scale(0.1 if name == "small.ply" else 1000)
        mesh.export(name)
    elif name == "tall.ply":
        mesh.vertices = mesh.vertices[:, [2, 1, 0]]
        mesh.export(name)
    elif name == "turned.ply":
        trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False).export(name)
    elif name == "nan.obj":
        Path(name).write_text("v 0 0 0\nv 1 0 0\nv nan 1 0\nv 1 1 2\nf 1 2 3\nf 2 3 4\n")
    elif name == "sparse.ply":
        trimesh.PointCloud(trimesh.sample.sample_surface(mesh, 300, seed=1)[0]).export(name)
    elif name == "empty.bt":
        Path(name).write_bytes(b"# Octomap OcTree binary file\nid OcTree\nres 0.1\ndata\n")
    elif name == "many.ply":
        Path(name).write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nelement face 10000000\n")
    before = sorted(Path().iterdir())
    assert main(["world", name, "--out", "here"]) == 2
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1 and sorted(Path().iterdir()) == before


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--scale", "0"], "--scale must be above 0 and finite"),
        (["--scale", "nan"], "--scale must be above 0 and finite"),
        (["--thickness", "2"], "--thickness must be above 0, to 1 m"),
        (["--up", "up"], "--up 'up' is no axis; give --up=x, --up=y, --up=z, --up=-x, --up=-y, --up=-z"),
    ],
)
def test_options_are_checked(words: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["world", "room.ply", "--out", "here", *words]) == 2
    assert says in capsys.readouterr().err


def test_a_folder_that_holds_something_is_left_alone(capsys: pytest.CaptureFixture[str]) -> None:
    Path("here").mkdir()
    Path("here/mine.txt").write_text("mine")
    assert main(["world", "room.ply", "--out", "here"]) == 2
    assert "exists and is not empty; name a new folder" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["evaluate", "check", "train"])
def test_commands_that_fly_name_the_one_that_makes_a_world(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    room().export("room.ply")
    words = {"evaluate": ["pretrained", "--world", "room.ply"], "check": ["room.ply"], "train": ["--world", "room.ply"]}
    assert main([command, *words[command]]) == 2
    said = capsys.readouterr().err
    assert "room.ply' is a scan; `edqn world " in said and "room.ply --out room` makes a world of it" in said
