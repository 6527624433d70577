"""`edqn check`: exit codes, the table, and the files that were asked for."""

from __future__ import annotations

import json
import sys
import types
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

from edqn_jax.cli import evaluate, main
from edqn_jax.devices import devices
from edqn_jax.evaluation import latency
from edqn_jax.evaluation.missions import MissionSet, load_missions
from edqn_jax.learn.policy import Policy
from tests.support.corridors import corridor
from tests.support.meshes import LUMP

evaluation = import_module("edqn_jax.evaluation.evaluate")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing that a test makes lands in the repository; the devices are those of the tests."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(devices, "use_cpu_devices", lambda count=None: None)


def test_a_world_that_is_flown_ends_with_0_and_writes_what_was_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = corridor(tmp_path, 1.4)
    assert main(["check", file.name]) == 0
    said = capsys.readouterr()
    assert "it can be flown" in said.out and "0.70 m of clearance, 1.9 body radii" in said.out
    assert "is tight at (12, 6, 2.5)" in said.out and "2 × box" in said.out and not said.err
    assert list(tmp_path.iterdir()) == [file]
    assert main(["check", "corridor.xml", "--out", "map.png", "--json", "found.json"]) == 0
    assert Path("map.png").read_bytes().startswith(b"\x89PNG")
    found = json.loads(Path("found.json").read_text())
    assert found["flies"] and found["way"]["clearance_m"] == pytest.approx(0.7, abs=0.01)
    assert found["policy"] == "pretrained" and len(found["geoms"]) == 3 and len(found["trained_in_m"]) == 6


def test_the_parameters_of_the_policy_are_not_read_and_the_world_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    corridor(tmp_path, 1.4)
    read = []
    policies, world_check = import_module("edqn_jax.runs.policies"), import_module("edqn_jax.evaluation.world_check")
    load = world_check.load_world
    monkeypatch.setattr(policies, "load_params", lambda *_: pytest.fail("parameters were read"))
    for module in (world_check, import_module("edqn_jax.evaluation.places")):
        monkeypatch.setattr(module, "load_world", lambda path: (read.append(path), load(path))[1])
    assert main(["check", "corridor.xml"]) == 0
    assert len(read) == 1


def test_a_world_that_is_not_flown_ends_with_1_and_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    corridor(tmp_path, 0.0)
    assert main(["check", "corridor.xml", "--out", "map.png", "--json", "found.json"]) == 1
    said = capsys.readouterr()
    assert "it cannot be flown" in said.out
    assert (
        said.err.startswith("edqn: 'corridor.xml' has no way from its start to its goal") and said.err.count("\n") == 1
    )
    assert Path("map.png").is_file() and not json.loads(Path("found.json").read_text())["flies"]


def test_what_is_refused_is_in_the_table_and_nothing_is_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    corridor(tmp_path, 3.0, '<geom name="egg" type="sdf" mesh="lump" pos="6 6 3"/>', asset=LUMP)
    assert main(["check", "corridor.xml", "--out", "map.png"]) == 1
    said = capsys.readouterr()
    assert "1 × refused" in said.out and "egg: is of the unsupported kind sdf" in said.out
    assert "'egg' is of the unsupported kind sdf; make it a box" in said.err
    assert not Path("map.png").exists()


def test_names_that_look_like_markup_are_printed_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    corridor(tmp_path, 3.0, '<geom name="[/b] [red]x" size=".2" pos="6 2 1"/>')
    assert main(["check", "corridor.xml"]) == 0
    assert "spheres: [/b] [red]x" in capsys.readouterr().out


def test_evaluate_prints_the_warnings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def flown(policy: Policy, world: str, announce: Callable[[MissionSet], None], **_: object) -> types.SimpleNamespace:
        missions = load_missions(policy.config, world)
        announce(missions)
        return types.SimpleNamespace(missions=missions, figures={})

    corridor(tmp_path, 1.4)
    monkeypatch.setattr(evaluation, "evaluate", flown)
    monkeypatch.setattr(latency, "decision_latency_ms", lambda *_, **__: {})
    monkeypatch.setattr(evaluate, "figures_table", lambda _: "")
    assert main(["evaluate", "pretrained", "--world", "corridor.xml"]) == 0
    assert "the widest way of 'corridor.xml' is tight at" in capsys.readouterr().out


def test_train_prints_the_warnings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in = types.ModuleType("edqn_jax.runs.record")
    stand_in.__dict__.update(train_run=lambda *_, **__: None, Draw=None)
    monkeypatch.setitem(sys.modules, "edqn_jax.runs.record", stand_in)
    corridor(tmp_path, 1.4)
    assert main(["train", "--world", "corridor.xml", "--tuned-for", "cpu", "--run-dir", "here"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "is tight at" in said and "m, 1.9 radii of the body" in said


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["nowhere.xml"], "there is no scene file 'nowhere.xml'"),
        (["mediun"], "did you mean 'medium'?"),
        (["bad.xml"], "bad.xml is not an MJCF"),
        (["corridor.xml", "--out", "map.jpg"], "--out 'map.jpg' must end in .png"),
        (["corridor.xml", "--out", "map.png", "--json", "./map.png"], "--out and --json are both 'map.png'"),
        (["corridor.xml", "--out", "nowhere/map.png"], "there is no folder"),
        (["corridor.xml", "--policy", "nowhere"], "there is no run in 'nowhere'"),
        (["corridor.xml", "--start", "nan", "1", "2"], "--start must be three finite numbers"),
        (["corridor.xml", "--strat", "1", "1", "2"], "did you mean '--start'?"),
        (["rooms", "--seed", "-1"], "--seed must be from 0"),
    ],
)
def test_invalid_input_ends_with_2_a_sentence_and_nothing_written(
    words: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.xml").write_text("<mujoco><worldbody>")
    corridor(tmp_path, 3.0)
    before = sorted(tmp_path.iterdir())
    assert main(["check", *words]) == 2
    said = capsys.readouterr()
    assert says in said.err and said.err.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
