"""Depth of fields beside MuJoCo's: what is compared, and where silhouettes are."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import fields
from tests.support.meshes import CUBE, bracket, hull, mesh_world


def test_a_plane_has_no_silhouettes_and_a_step_has_them_on_both_sides() -> None:
    row, column = np.indices((6, 8))
    plane = 1 / (0.2 + 0.03 * row + 0.05 * column)
    assert not fields.at_silhouettes(plane[None]).any()
    step = np.where(column < 4, 2.0, 5.0)
    found = fields.at_silhouettes(step[None])[0]
    assert found[:, 3:5].all() and found.sum() == 12
    assert not fields.at_silhouettes(np.full((1, 6, 8), 3.0)).any()


def test_depth_of_a_block_is_that_of_mujoco(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = mesh_world(
        tmp_path, '<geom name="block" type="mesh" mesh="block" pos="10 5 3"/>', block=hull(CUBE * [1.0, 2.0, 1.5])
    )
    report = tmp_path / "found.json"
    assert fields.main([str(world), "--pictures", "4", "--json", str(report)]) == 0
    (row,) = json.loads(report.read_text())["rows"]
    assert row["pixels"] == 4 * 24 * 32 and row["share"] > 0.95 and row["share_elsewhere"] > 0.98
    assert row["share"] + row["too_near"] + row["too_far"] == pytest.approx(1)
    assert "% of 3,072 pixels" in capsys.readouterr().out


def test_distances_to_a_bracket_are_those_of_trimesh(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = mesh_world(tmp_path, '<geom type="mesh" mesh="b" pos="10 5 3" euler="0 0 20"/>', b=bracket())
    report = tmp_path / "found.json"
    assert fields.main([str(world), "--pictures", "1", "--points", "400", "--json", str(report)]) == 0
    _, row = json.loads(report.read_text())["rows"]
    assert row["points"] == 400 and row["share"] > 0.95 and 1 < row["slope"] < 4
    assert -0.01 < row["too_large_m_most_near"] <= row["too_large_m_most"] < 0.01
    assert 0 <= row["too_small_m_median"] < 0.02 and row["too_small_m_most"] < 0.1
    assert "of 400 distances" in capsys.readouterr().out


def test_distances_to_convex_meshes_alone_are_not_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = mesh_world(tmp_path, '<geom type="mesh" mesh="block" pos="10 5 3"/>', block=hull(CUBE))
    assert fields.main([str(world), "--pictures", "1", "--points", "10"]) == 2
    assert "must have meshes, none of them convex" in capsys.readouterr().err


def test_a_world_that_is_not_there_is_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert fields.main(["nowhere.xml"]) == 2
    assert "nowhere.xml" in capsys.readouterr().err
