"""The examples of the pages on deployment and on files of events run, and PX4's frames are turned into ours."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edqn_jax.interop.deployment import runner
from edqn_jax.interop.deployment.onnx_export import export_policy
from edqn_jax.runs.policies import load_policy

DOCS = Path(__file__).parents[2] / "docs"

pytestmark = pytest.mark.filterwarnings("ignore")  # jax2onnx and what it imports


def examples(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


def frames() -> dict[str, Any]:
    found: dict[str, Any] = {}
    exec(examples("deployment.md")[1], found)
    return found


def test_the_runner_of_the_page_decides(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    export_policy(load_policy("pretrained"), tmp_path / "policy.onnx", checks=20)
    exec(examples("deployment.md")[0], {})
    assert re.match(r"\d+ \[", capsys.readouterr().out)


def test_the_events_of_the_page_are_written_and_read(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for example in examples("event_files.md"):
        exec(example, {})
    assert "(346, 260)" in capsys.readouterr().out
    shutil.rmtree(tmp_path)


def test_places_and_headings_are_those_of_px4():
    there = frames()
    assert there["from_ned"]([1.0, 2.0, -3.0]).tolist() == [2.0, 1.0, 3.0]
    assert there["to_ned"](there["from_ned"]([1.0, 2.0, 3.0])).tolist() == [1.0, 2.0, 3.0]
    assert there["yaw_to_ned"](0.0) == pytest.approx(np.pi / 2)  # east
    assert there["yaw_to_ned"](np.pi / 2) == pytest.approx(0.0)  # north


def test_attitudes_are_those_of_px4():
    there = frames()
    swap, flip = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1.0, -1, -1])
    for turn in Rotation.from_quat(np.random.default_rng(0).normal(size=(20, 4))):
        q = turn.as_quat(scalar_first=True)
        found = Rotation.from_quat(there["quaternion_from_ned"](q), scalar_first=True).as_matrix()
        np.testing.assert_allclose(found, swap @ turn.as_matrix() @ flip, atol=1e-12)
    level = Rotation.from_euler("z", 30, degrees=True).as_quat(scalar_first=True)  # 30 degrees east of north
    yaw = runner.heading_of(there["quaternion_from_ned"](level).astype(np.float32))
    assert np.degrees(yaw) == pytest.approx(60.0, abs=1e-4)
