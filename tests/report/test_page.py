"""The data of the page of runs: worlds, flights, curves, names, and what must not get into HTML unescaped."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.colors import Normalize
from PIL import Image

from edqn_jax.cli import main
from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.devices import devices
from edqn_jax.report.page import document
from edqn_jax.report.page.contents import COLUMNS, _by_interest, flight_data, learning_curves, script_text
from edqn_jax.report.page.evaluated import EvaluatedRun, _chosen_by, folders_of, names_of
from edqn_jax.report.page.pictures import LEVELS, picture_strip
from edqn_jax.report.page.worlds import world_data
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.scene import Scene
from edqn_jax.sim.task.flights import Closest, Flights, Record
from edqn_jax.sim.task.outcomes import Outcome

HOSTILE = "</script><img src=x onerror=alert(1)>&"

ROOM = """
<mujoco>
  <worldbody>
    <site name="start" pos="2 2 2"/>
    <site name="goal" pos="18 8 2"/>
    <site name="volume" type="box" pos="10 5 2.5" size="10 5 2.5" group="3"/>
    <geom type="box" name="ceiling" pos="10 5 4.9" size="10 5 .1" rgba=".5 .5 .5 1"/>
    <geom type="box" name="wall" pos="10 9.9 2.5" size="10 .1 2.5" rgba=".5 .5 .5 1"/>
    <geom type="capsule" pos="6 5 1" size=".5 1" euler="90 0 0" rgba="1 0 0 1"/>
    <geom type="sphere" pos="9 5 1" size=".8" rgba="0 0 1 1"/>
    <geom type="cylinder" pos="12 5 2" size=".4 2" rgba="0 1 0 1"/>
  </worldbody>
</mujoco>
"""


def a_run(steps: int = 40, name: str = "a run") -> EvaluatedRun:
    """A flight straight along x of a policy that is not there."""
    config = Config()
    x = np.arange(1, steps + 1, dtype=np.float32)
    position = np.stack([x, 0 * x, 0 * x + 2], axis=-1)[None]
    record = Record(
        position=jnp.asarray(position),
        quaternion=jnp.tile(jnp.array([1.0, 0, 0, 0]), (1, steps, 1)),
        velocity=jnp.tile(jnp.array([3.0, 0, 4]), (1, steps, 1)),
        clearance=jnp.asarray(x[None]),
        action=jnp.zeros((1, steps), jnp.int32),
        reward=jnp.zeros((1, steps)),
    )
    one = jnp.ones(1)
    closest = Closest(distance=one, time=one, position=jnp.ones((1, 3)), quaternion=jnp.ones((1, 4)))
    flights = Flights(
        outcome=jnp.array([Outcome.COLLISION]),
        decisions=jnp.array([3]),
        physics_steps=jnp.array([steps]),
        contact=one,
        episode_return=one,
        path_length_m=one,
        flight_seconds=one,
        closest=closest,
        record=record,
    )
    ends = SimpleNamespace(start=np.zeros((1, 3)), goal=np.ones((1, 3)), scene=np.zeros(1, int))
    missions: Any = SimpleNamespace(name="paper", env_params=SimpleNamespace(missions=ends))
    params: Any = None
    return EvaluatedRun(name, config, "train: {}", params, missions, flights, {}, [], {}, [])


def test_a_world_has_every_shape_with_its_size_and_colour(tmp_path: Path) -> None:
    file = tmp_path / "room.xml"
    file.write_text(ROOM)
    world = world_data(load_scene(file))
    assert (world["lower"], world["upper"]) == ([0, 0, 0], [20, 10, 5])
    shapes = {(shape["kind"], shape["colour"]): shape for shape in world["shapes"][2:]}
    capsule = shapes["capsule", "#ff0000"]
    assert (capsule["radius"], capsule["half"]) == (0.5, 1.0) and np.allclose(np.abs(capsule["axis"]), [0, 1, 0])
    assert shapes["sphere", "#0000ff"] == {"kind": "sphere", "at": [9, 5, 1], "radius": 0.8, "colour": "#0000ff"}
    assert shapes["cylinder", "#00ff00"]["axis"] == [0, 0, 1]


def test_a_ceiling_and_an_outer_wall_say_which_side_they_close(tmp_path: Path) -> None:
    file = tmp_path / "room.xml"
    file.write_text(ROOM)
    closes = [shape.get("closes") for shape in world_data(load_scene(file))["shapes"]]
    assert sorted(filter(None, closes)) == [[1, 1], [2, 1]] and len(closes) == 5


def test_a_mesh_is_shown_itself_and_says_that_it_hides_flights(roofed: Scene) -> None:
    shape = world_data(roofed)["shapes"][0]
    assert shape["kind"] == "mesh" and shape["hides"] and "closes" not in shape
    placed = np.reshape(shape["vertices"], (-1, 3)) @ np.reshape(shape["turn"], (3, 3)).T + shape["at"]
    np.testing.assert_allclose([placed.min(0), placed.max(0)], [[2, 1, 0.5], [18, 9, 5.5]], atol=2e-3)
    assert np.shape(shape["triangles"]) == (24, 3)


def test_the_view_uses_of_three_what_is_in_its_bundle() -> None:
    page = Path(document.__file__).parent
    used = set(re.findall(r"THREE\.(\w+)", (page / "page.js").read_text(encoding="utf-8")))
    bundled = set(re.findall(r"\w+", (page / "vendored" / "three.entry.mjs").read_text(encoding="utf-8")))
    assert used and used <= bundled


@pytest.mark.parametrize(
    ("world", "keep", "flights", "said"),
    [
        ("paper", "best", 8, True),
        ("paper", "last", 8, False),
        ("paper", "best", 1, False),
        ("medium", "best", 8, False),
    ],
)
def test_a_page_says_where_its_flights_chose_the_policy(world: str, keep: Any, flights: int, said: bool) -> None:
    config = make_config(world, train={"keep": keep})
    assert bool(_chosen_by(config, flights)) == said


def test_a_flight_keeps_its_first_and_last_row_and_its_speed() -> None:
    flight = flight_data(a_run(), 0)
    rows = np.frombuffer(base64.b64decode(flight["rows"]), "<f4").reshape(-1, len(COLUMNS))
    of = dict(zip(COLUMNS, rows.T, strict=True))
    assert of["x"].tolist() == [1, 6, 11, 16, 21, 26, 31, 36, 40] and np.all(of["speed"] == 5)
    assert of["t"][-1] == pytest.approx(0.8) and flight["outcome"] == "collision"


def test_curves_are_running_means_at_the_last_of_their_episodes() -> None:
    steps = np.arange(40)
    episodes = {"step": 10 * steps, "return": 1.0 * steps, "outcome": np.where(steps < 20, "collision", "goal")}
    metrics = [{"decisions": 5, "validation_success": None}, {"decisions": 9, "validation_success": 0.5}]
    found = learning_curves(dataclasses.replace(a_run(), episodes=episodes, metrics=metrics))
    assert found["window"] == 4
    assert (found["return"]["x"][0], found["return"]["y"][0]) == (30, 1.5)
    assert (found["success"]["y"][0], found["success"]["y"][-1]) == (0, 1)
    assert found["validation"] == {"x": [9], "y": [0.5]}


def test_a_function_was_trained_nowhere() -> None:
    assert document.run_figures(a_run())["trained in"] == "–"


def test_a_run_without_episodes_has_no_curves() -> None:
    assert learning_curves(a_run()) == {}


def test_pictures_stand_one_below_the_other_in_the_colours_of_their_scale() -> None:
    images = np.stack([np.zeros((3, 4)), np.ones((3, 4))])
    picture = Image.open(io.BytesIO(base64.b64decode(picture_strip(images, Normalize(0, 1), "gray"))))
    assert (picture.size, picture.mode) == ((4, 6), "P")
    pixels = np.asarray(picture.convert("L"))
    assert np.all(pixels[:3] == 0) and np.all(pixels[3:] == 255) and LEVELS <= 256


def test_pictures_are_first_of_the_first_flight_and_of_those_that_failed() -> None:
    assert _by_interest(["goal", "goal", "collision", "goal", "time_out"]) == [0, 2, 4, 1, 3]


def test_data_in_a_script_element_cannot_end_it() -> None:
    text = script_text({"name": HOSTILE})
    assert not set("<>&") & set(text) and json.loads(text) == {"name": HOSTILE}


def test_whatever_a_folder_says_is_escaped() -> None:
    run = dataclasses.replace(
        a_run(name=HOSTILE),
        config_text=HOSTILE,
        summary={"processor": HOSTILE, "versions": {HOSTILE: HOSTILE}, "outcome": HOSTILE},
        notes=[HOSTILE],
    )
    page = document.build_html([run, run], {"version": HOSTILE, "made": "now", "runs": [{"name": HOSTILE}]})
    assert "<img" not in page and page.count("&lt;img src=x onerror=alert(1)&gt;&amp;") >= 8


def test_the_page_names_no_address_to_load_from() -> None:
    page = document.build_html([a_run()], {"version": "1", "made": "now"})
    for mark in ("src=", "href=", "url(", "@import"):
        assert mark not in page.replace("img-src", ""), mark
    assert "default-src 'none'" in page


def test_runs_are_named_by_as_much_of_their_paths_as_tells_them_apart() -> None:
    assert names_of([Path("/a/one"), Path("/a/two")]) == ["one", "two"]
    assert names_of([Path("/a/one"), Path("/b/one")]) == ["a/one", "b/one"]
    assert names_of([Path("/a/run/seed-0"), Path("/a/run/seed-1")]) == ["run/seed-0", "run/seed-1"]


def test_the_folder_of_several_seeds_stands_for_each_of_them(tmp_path: Path) -> None:
    for seed in (2, 10, 1):
        (tmp_path / f"seed-{seed}").mkdir()
    assert [folder.name for folder in folders_of(tmp_path)] == ["seed-1", "seed-2", "seed-10"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["{0}"], "there is no run in"),
        (["pretrained", "--out", "{0}/page.txt"], "must end in .html"),
        (["pretrained", "--out", "{0}/no/page.html"], "there is no folder"),
        (["pretrained", "--missions", "0"], "--missions must be at least 1"),
        (["pretrained", "--mission", "1"], "did you mean '--missions'?"),
    ],
)
def test_what_cannot_be_shown_is_refused_with_one_sentence(arguments, says, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(devices, "use_cpu_devices", lambda count=None: None)
    assert main(["report", *(word.format(tmp_path) for word in arguments)]) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_run_whose_files_are_damaged_is_refused(tmp_path, monkeypatch, capsys) -> None:
    from edqn_jax.report.page import evaluated

    (tmp_path / "config.yaml").write_text("train: {seed: 0}")
    (tmp_path / "metrics.jsonl").write_text("{not JSON")
    monkeypatch.setattr(evaluated, "load_run", lambda folder: (Config(), jnp.zeros(())))
    monkeypatch.setattr(devices, "use_cpu_devices", lambda count=None: None)
    assert main(["report", str(tmp_path)]) == 2
    assert "is not as a run writes it" in capsys.readouterr().err
    assert not (tmp_path / "report.html").exists()
