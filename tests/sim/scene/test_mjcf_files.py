"""What a world's file may hold: of other files meshes and height fields alone, and nothing huge."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edqn_jax.sim.scene.mjcf import MAX_SHAPES, SceneError, load_world
from edqn_jax.sim.scene.mjcf_parts import files as mjcf_files

SITES = '<site name="start" pos="1 1 2"/><site name="goal" pos="9 1 2"/>'


def world(folder: Path, inside: str) -> Path:
    file = folder / "world.xml"
    file.write_text(f"<mujoco>{inside}<worldbody>{SITES}</worldbody></mujoco>")
    return file


@pytest.mark.parametrize(
    ("inside", "says"),
    [
        ('<include file="../secret.xml"/>', "names the file '../secret.xml' in <include>, which lies outside"),
        ('<include file="none.xml"/>', "names the file 'none.xml' in <include>, and there is none in"),
        ('<include file="world.xml"/>', "includes 'world.xml' twice"),
        ('<asset><model name="a" file="secret.xml"/></asset>', "has <model>"),
        ('<asset><material name="a" file="secret.png"/></asset>', "names the file 'secret.png' in <material>"),
        (
            '<asset><mesh name="a" file="none.stl"/></asset>',
            "names the file 'none.stl' in <mesh>, and there is none in",
        ),
        ('<extension><plugin plugin="mujoco.sdf.bolt"/></extension>', "has <extension>"),
        ('<asset><hfield name="a" nrow="99999" ncol="99999" size="1 1 1 1"/></asset>', "field 'a' of 99999 x 99999"),
        ('<asset><hfield name="a" nrow="0" ncol="0" size="1 1 1 1"/></asset>', "field 'a' of 0 x 0; it must be 2 x 2"),
        ('<asset><mesh builtin="supersphere" params="9000 1 1"/></asset>', "params=...> of more than 100"),
        ('<custom><numeric name="a" size="900000000"/></custom>', "size=...> of more than 4096"),
        ('<worldbody><flexcomp name="a" type="grid" count="60 60 60"/></worldbody>', "has <flexcomp>"),
    ],
)
def test_what_a_static_world_does_not_need_is_refused_before_mujoco_sees_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, inside: str, says: str
) -> None:
    monkeypatch.setattr("edqn_jax.sim.scene.mjcf.mujoco.MjModel.from_xml_string", None)
    with pytest.raises(SceneError, match=says):
        load_world(world(tmp_path, inside))


@pytest.mark.parametrize(
    "text",
    [
        # One parser ends the declaration at its first '>', another at its last.
        "<!DOCTYPE mujoco [<!ENTITY a \"><mujoco><include file='x.xml'/></mujoco><!--\">]><mujoco/> <!-- -->",
        '<!DOCTYPE mujoco [<!ENTITY a "haha"><!ENTITY b "&a;&a;&a;">]><mujoco model="&b;"/>',
        '<robot name="a"><link name="b"/></robot>',
        "<mujoco>" * 100_000,
    ],
)
def test_what_parsers_may_read_differently_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "world.xml"
    file.write_text(text)
    with pytest.raises(SceneError, match="world.xml (is not an MJCF|has a <!DOCTYPE>)"):
        load_world(file)


def test_mujoco_writes_no_log_into_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneError):
        load_world(world(tmp_path, '<worldbody><geom size="nan"/></worldbody>'))
    assert [path.name for path in tmp_path.iterdir()] == ["world.xml"]
    assert capfd.readouterr() == ("", "")


def test_copies_and_sizes_have_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copies = '<replicate count="2000" offset="1 0 0">' * 2 + '<geom size="1"/>' + "</replicate>" * 2
    with pytest.raises(SceneError, match=r"asks for 4,00\d,000 copies by replicate; a world may have 10,000"):
        load_world(world(tmp_path, f"<worldbody>{copies}</worldbody>"))
    many = "".join(f'<geom size="0.1" pos="{x} 0 0"/>' for x in range(MAX_SHAPES + 1))
    with pytest.raises(SceneError, match=f"has {MAX_SHAPES + 1} geoms; a world may have {MAX_SHAPES}"):
        load_world(world(tmp_path, f"<worldbody>{many}</worldbody>"))
    monkeypatch.setattr(mjcf_files, "MAX_BYTES", 100)
    with pytest.raises(SceneError, match=r"has 1\d\d bytes; a world may have 100"):
        load_world(world(tmp_path, ""))


LOOPS = {
    "one.xml": '<mujoco><include file="two.xml"/></mujoco>',
    "two.xml": '<mujoco><include file="one.xml"/></mujoco>',
}


def test_what_a_world_includes_is_part_of_it_as_in_mujoco(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "looks.xml").write_text(
        '<mujoco><size memory="900G"/><asset><texture type="2d" name="wood" file="none.png"/>'
        '<texture type="2d" name="huge" builtin="flat" width="100000" height="9"/>'
        '<texture type="cube" file="parts/sky.png" gridsize="1 1"/>'
        '<material name="brown" texture="wood" rgba=".5 .3 .1 1"/><material name="b" texture="sky"/></asset></mujoco>'
    )
    (tmp_path / "parts" / "table.xml").write_text(
        '<mujocoinclude><geom name="top" type="box" size="1 1 .1" pos="0 0 1" material="brown"/>'
        '<include file="parts/leg.xml"/></mujocoinclude>'
    )
    (tmp_path / "parts" / "leg.xml").write_text(
        '<mujoco><geom name="leg" type="box" size=".1 .1 .5" pos="0 0 .5"/></mujoco>'
    )
    file = world(
        tmp_path,
        '<include file="parts/looks.xml"/>'
        '<worldbody><body pos="5 1 0"><include file="parts/table.xml"/></body></worldbody>',
    )
    loaded = load_world(file)
    assert loaded.names["boxes"] == ("top", "leg")
    np.testing.assert_allclose(loaded.scene.boxes.position, [[5, 1, 1], [5, 1, 0.5]])
    np.testing.assert_allclose(loaded.scene.boxes.albedo[0], [0.5, 0.3, 0.1], atol=1e-6)
    copied = tmp_path / "copy.xml"
    copied.write_bytes(mjcf_files.self_contained_bytes(file))
    (tmp_path / "parts").rename(tmp_path / "elsewhere")
    assert load_world(copied).names == loaded.names


def test_what_is_included_has_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, text in LOOPS.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(SceneError, match="includes 'one.xml' twice; MuJoCo allows it once"):
        load_world(world(tmp_path, '<include file="one.xml"/>'))
    deep = 300
    (tmp_path / "deep.xml").write_text(f"<mujoco>{'<body>' * deep}{'</body>' * deep}</mujoco>")
    inner = "<body>" * deep + '<include file="deep.xml"/>' + "</body>" * deep
    with pytest.raises(SceneError, match="has more than 500 elements within each other"):
        load_world(world(tmp_path, f"<worldbody>{inner}</worldbody>"))
    (tmp_path / "broken.xml").write_text("<mujoco>")
    with pytest.raises(SceneError, match="broken.xml is not an MJCF"):
        load_world(world(tmp_path, '<include file="broken.xml"/>'))
    (tmp_path / "long.xml").write_text(f"<mujoco>{' ' * 500}</mujoco>")
    monkeypatch.setattr(mjcf_files, "MAX_BYTES", 400)
    with pytest.raises(SceneError, match=r"long.xml' has 517 bytes; a world may have 400"):
        load_world(world(tmp_path, '<include file="long.xml"/>'))
