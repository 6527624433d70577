"""What a world's file may hold: of other files meshes and height fields alone, and nothing huge."""

from __future__ import annotations

from pathlib import Path

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
        ('<include file="../secret.xml"/>', "has <include>; a world is one file"),
        ('<asset><model name="a" file="secret.xml"/></asset>', "has <model>"),
        ('<asset><texture type="2d" name="a" file="secret.png"/></asset>', "names the file 'secret.png' in <texture>"),
        ('<asset><texture type="cube" name="a" fileright="x.png"/></asset>', "names the file 'x.png' in <texture>"),
        (
            '<asset><mesh name="a" file="none.stl"/></asset>',
            "names the file 'none.stl' in <mesh>, and there is none in",
        ),
        ('<extension><plugin plugin="mujoco.sdf.bolt"/></extension>', "has <extension>"),
        ('<asset><hfield name="a" nrow="99999" ncol="99999" size="1 1 1 1"/></asset>', "field 'a' of 99999 x 99999"),
        ('<asset><hfield name="a" nrow="0" ncol="0" size="1 1 1 1"/></asset>', "field 'a' of 0 x 0; it must be 2 x 2"),
        ('<size memory="900G"/>', "has <size>"),
        (
            '<asset><texture type="2d" builtin="flat" width="100000" height="9"/></asset>',
            "width=...> of more than 4096",
        ),
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
