"""What a world's files may be: in its own folder, and small enough."""

from __future__ import annotations

from pathlib import Path

import pytest

from edqn_jax.sim import mjcf_files
from edqn_jax.sim.mjcf import MOST_SHAPES, SceneError, load_world
from edqn_jax.sim.mjcf_files import files_of

SITES = '<site name="start" pos="1 1 2"/><site name="goal" pos="9 1 2"/>'


def world(folder: Path, inside: str, name: str = "world.xml") -> Path:
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"<mujoco>{inside}</mujoco>")
    return file


def test_a_world_may_be_made_of_several_files_in_its_folder(tmp_path: Path) -> None:
    part = world(tmp_path, '<worldbody><geom name="ball" size="1" pos="5 1 2"/></worldbody>', "parts/ball.xml")
    file = world(tmp_path, f'<include file="parts/ball.xml"/><worldbody>{SITES}</worldbody>')
    assert files_of(file) == [file, part]
    assert load_world(file).names["spheres"] == ("ball",)


@pytest.mark.parametrize(
    "inside",
    [
        '<include file="../secret.xml"/>',
        '<include file="{outside}/secret.xml"/>',
        '<include file="linked.xml"/>',
        '<asset><texture type="2d" file="../secret.xml"/></asset>',
        '<compiler meshdir=".."/><asset><mesh file="secret.xml"/></asset>',
        '<compiler assetdir="{outside}"/><asset><hfield file="secret.xml"/></asset>',
        '<asset><model file="../secret.xml"/></asset>',
        '<include file="parts/part.xml"/>',
    ],
)
def test_what_lies_outside_of_its_folder_is_refused_before_it_is_opened(tmp_path: Path, inside: str) -> None:
    (tmp_path / "secret.xml").write_text("<mujoco>password</mujoco>")
    folder = tmp_path / "worlds"
    file = world(folder, inside.format(outside=tmp_path) + f"<worldbody>{SITES}</worldbody>")
    world(folder, '<include file="../../secret.xml"/>', "parts/part.xml")
    (folder / "linked.xml").symlink_to(tmp_path / "secret.xml")
    with pytest.raises(SceneError, match=r"names '.*secret.xml'|names '.*linked.xml'") as refused:
        load_world(file)
    assert f"outside of the world's folder '{folder}'" in str(refused.value) and "password" not in str(refused.value)


def test_copies_and_sizes_have_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copies = '<replicate count="2000" offset="1 0 0">' * 2 + '<geom size="1"/>' + "</replicate>" * 2
    with pytest.raises(SceneError, match=r"asks for 4,00\d,000 copies by replicate; a world may have 10,000"):
        load_world(world(tmp_path, f"<worldbody>{SITES}{copies}</worldbody>"))
    many = "".join(f'<geom size="0.1" pos="{x} 0 0"/>' for x in range(MOST_SHAPES + 1))
    with pytest.raises(SceneError, match=f"has {MOST_SHAPES + 1} geoms; a world may have {MOST_SHAPES}"):
        load_world(world(tmp_path, f"<worldbody>{SITES}{many}</worldbody>"))
    monkeypatch.setattr(mjcf_files, "MOST_BYTES", 100)
    with pytest.raises(SceneError, match=r"has 2\d\d bytes; a world may have 100"):
        load_world(world(tmp_path, f"<worldbody>{SITES}</worldbody>" + " " * 100))


def test_entities_that_multiply_are_refused(tmp_path: Path) -> None:
    layers = "".join(f'<!ENTITY e{n} "{f"&e{n - 1};" * 10}">' for n in range(1, 12))
    file = tmp_path / "bomb.xml"
    file.write_text(f'<!DOCTYPE mujoco [<!ENTITY e0 "ha">{layers}]><mujoco model="&e11;"/>')
    with pytest.raises(SceneError, match="is not an MJCF"):
        load_world(file)


def test_files_that_include_each_other_end(tmp_path: Path) -> None:
    one = world(tmp_path, '<include file="two.xml"/>', "one.xml")
    two = world(tmp_path, '<include file="one.xml"/>', "two.xml")
    assert files_of(one) == [one, two]
