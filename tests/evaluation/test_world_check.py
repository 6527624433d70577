"""Whether a policy will fly in a world: what geoms became, the way, sizes, costs, and what is worth a warning."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from edqn_jax.config import Config
from edqn_jax.config.simulation import WorldConfig
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import MissionSet, load_missions
from edqn_jax.evaluation.world_check import (
    MARGIN_M,
    check_world,
    estimate_cost,
    trained_sizes,
    warn_of_missions,
    warn_of_training,
)
from edqn_jax.runs.directory import to_plain_json
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.surface import SURFACE_NUMBERS
from edqn_jax.sim.scene.survey import LEFT_OUT
from tests.support.corridors import corridor
from tests.support.meshes import CUBE, LUMP, hull, mesh_world

ROOMS = dataclasses.replace(Config(), world=WorldConfig(name="rooms"))
RADIUS = ROOMS.drone.body_radius_m
WIDE = 3.0  # metres of a door that nobody is warned of


def test_a_corridor_of_known_width_is_flown_and_measured(tmp_path: Path) -> None:
    found = check_world(ROOMS, str(corridor(tmp_path, 2.4)))
    assert found.refusal is None and found.warnings == () and found.way is not None
    assert found.way.clearance_m == pytest.approx(1.2, abs=0.01)
    assert found.nearest in ("'south'", "'north'")
    assert found.shapes == {"boxes": 2, "planes": 1} and found.moving == 0


def test_a_tight_way_is_flown_with_a_warning(tmp_path: Path) -> None:
    width = 2 * (RADIUS + MARGIN_M)
    (warning,) = check_world(ROOMS, str(corridor(tmp_path, width - 0.1))).warnings
    assert "is tight at (12, 6, 2.5): it passes" in warning and "0.91 m, 2.5 radii of the body" in warning
    assert check_world(ROOMS, str(corridor(tmp_path, width + 0.1))).warnings == ()


def test_patterns_that_a_file_brings_are_warned_of_where_the_policy_knows_one_look(tmp_path: Path) -> None:
    file, stripes = corridor(tmp_path, WIDE), "3 0.5 1 0 0 0.5 " + "0 " * (SURFACE_NUMBERS - 6)
    custom = f'<custom><numeric name="surface:south" data="{stripes}"/></custom>'
    file.write_text(file.read_text().replace("</mujoco>", f"{custom}</mujoco>"))
    (warning,) = check_world(ROOMS, str(file)).warnings
    assert "the shapes of this world have patterns of their own" in warning


@pytest.mark.parametrize(
    ("door", "said"),
    [(0.0, "is wide enough|all are closed"), (0.6, "at 0.30 m, closer than the drone's radius of 0.36 m")],
)
def test_a_door_that_is_closed_or_too_narrow_is_not_flown(door: float, said: str, tmp_path: Path) -> None:
    found = check_world(ROOMS, str(corridor(tmp_path, door)))
    assert found.refusal is not None
    assert any(each in found.refusal for each in said.split("|"))
    with pytest.raises(ConfigError):
        load_missions(ROOMS, str(corridor(tmp_path, door)))


def test_an_end_within_a_shape_or_none_at_all_is_not_flown(tmp_path: Path) -> None:
    file = str(corridor(tmp_path, WIDE))
    inside = check_world(ROOMS, file, start=(12.0, 1.0, 2.0))
    assert (
        inside.refusal is not None and "start (12, 1, 2)" in inside.refusal and "lies inside 'south'" in inside.refusal
    )
    Path(file).write_text(Path(file).read_text().replace('name="goal"', 'name="gaol"'))
    missing = check_world(ROOMS, file)
    assert missing.refusal is not None and "does not say where its goal is" in missing.refusal
    assert missing.scene is not None and missing.way is None
    json.dumps(to_plain_json(missing.figures()), allow_nan=False)


def test_each_geom_is_said_to_have_become_a_shape_or_why_not(tmp_path: Path) -> None:
    geoms = (
        '<geom name="ghost" size="1" pos="6 6 3" group="3" contype="0" conaffinity="0"/>'
        '<geom name="post" type="cylinder" size=".2 1" pos="6 2 1"/>'
        '<geom name="log" type="cylinder" size=".2 1" pos="6 9 1" euler="90 0 0"/>'
        '<geom name="glass" type="box" size=".1 .1 .1" pos="7 1 1" rgba="1 1 1 .5"/>'
        '<light pos="0 0 9"/>'
    )
    texture = '<texture name="t" type="2d" builtin="checker" width="8" height="8"/>'
    found = check_world(ROOMS, str(corridor(tmp_path, WIDE, geoms, asset=texture)))
    assert found.survey is not None and found.survey.refused == []
    became = {fate.name: (fate.became, fate.why) for fate in found.survey.geoms}
    assert became["ghost"] == (None, LEFT_OUT)
    assert {name: kind for name, (kind, _) in became.items() if name != "ghost"} == {
        "ground": "planes",
        "south": "boxes",
        "north": "boxes",
        "post": "cylinders",
        "log": "tilted_cylinders",
        "glass": "boxes",
    }
    assert [each.partition(":")[0] for each in found.survey.ignored] == [
        "1 × texture",
        "1 × geom's transparency",
        "1 × light",
    ]


def test_a_mesh_becomes_a_field_that_c_draws_and_cuda_does_not(tmp_path: Path) -> None:
    file = mesh_world(tmp_path, '<geom name="block" type="mesh" mesh="cube" pos="10 2 2"/>', cube=hull(CUBE))
    found = check_world(ROOMS, str(file))
    assert found.survey is not None and found.cost is not None and found.refusal is None
    assert [fate.became for fate in found.survey.geoms] == ["planes", "fields"]
    assert found.cost.drawn_by_jax == [] and found.cost.drawn_by_jax_on_gpus == ["fields"]
    assert not found.warnings
    plain = check_world(ROOMS, str(corridor(tmp_path, WIDE))).cost
    assert plain is not None and plain.drawn_by_jax == [] and found.cost.picture_us > 10 * plain.picture_us
    assert 20_000 < plain.decisions_per_s < 35_000 and found.cost.decisions_per_s < plain.decisions_per_s / 2
    assert 2_000 < found.cost.decisions_per_s < 2_800  # measured: 1,191 a core where one field fills all pictures
    grid = load_scene(file).others["fields"].grids[0]
    assert found.cost.world_bytes > grid.values.nbytes and found.cost.training_bytes > 2 * grid.values.nbytes


def test_each_geom_that_is_refused_has_its_reason(tmp_path: Path) -> None:
    geoms = (
        '<geom name="egg" type="sdf" mesh="lump" pos="6 6 3"/>'
        '<body name="cart" pos="6 2 1"><joint/><geom name="load" size="1"/></body>'
    )
    found = check_world(ROOMS, str(corridor(tmp_path, WIDE, geoms, asset=LUMP)))
    assert found.survey is not None and found.scene is None
    assert {fate.name: fate.why.partition(";")[0] for fate in found.survey.refused} == {
        "egg": "is of the unsupported kind sdf",
        "load": "is on a body that can move",
    }
    assert found.refusal is not None and "'egg' is of the unsupported kind" in found.refusal
    assert "and 1 more" in found.refusal
    assert sum(fate.became is not None for fate in found.survey.geoms) == 3


@pytest.mark.parametrize(("size", "said"), [("12 1e-9 3", "is empty"), ("1200 6 3", "is longer than 500 m")])
def test_a_volume_in_which_nothing_flies_is_named_and_not_drawn(size: str, said: str, tmp_path: Path) -> None:
    file = corridor(tmp_path, WIDE)
    file.write_text(file.read_text().replace('size="12.0 6 3"', f'size="{size}"'))
    found = check_world(ROOMS, str(file))
    assert found.scene is None and found.refusal is not None and said in found.refusal


@pytest.mark.parametrize("text", ["<mujoco><worldbody>", "not a world", "<mujoco/>"])
def test_a_file_that_cannot_be_read_is_invalid_input(text: str, tmp_path: Path) -> None:
    (tmp_path / "bad.xml").write_text(text)
    with pytest.raises(ConfigError, match=r"bad\.xml"):
        check_world(ROOMS, str(tmp_path / "bad.xml"))


def test_a_world_much_larger_than_those_of_training_is_said_to_be(tmp_path: Path) -> None:
    file = str(corridor(tmp_path, WIDE, length=60.0))
    (warning,) = check_world(ROOMS, file).warnings
    assert "volume of 60 × 12 × 6 m is much larger" in warning and "at most 36 × 36 × 8 m" in warning
    assert check_world(dataclasses.replace(ROOMS, world=WorldConfig(name="medium")), file).warnings == ()
    assert check_world(dataclasses.replace(ROOMS, world=WorldConfig(name=file)), file).warnings == ()


def test_a_way_that_is_longer_than_a_flight_is_said_to_be(tmp_path: Path) -> None:
    short = dataclasses.replace(ROOMS, env=dataclasses.replace(ROOMS.env, max_decisions=10))
    (warning,) = check_world(short, str(corridor(tmp_path, WIDE))).warnings
    assert "18 m long, and in 10 decisions a flight of 4 m/s covers 10 m" in warning


def test_a_mixture_was_trained_in_the_sizes_of_its_families(tmp_path: Path) -> None:
    mixed = trained_sizes(dataclasses.replace(ROOMS, world=WorldConfig(name="mixed")))
    assert mixed["rooms"] == (36.0, 36.0, 8.0) and len(mixed) == 6
    assert trained_sizes(dataclasses.replace(ROOMS, world=WorldConfig(name=str(tmp_path / "gone.xml")))) == {}


@pytest.mark.whole
def test_a_random_world_is_checked_by_its_number() -> None:
    found = check_world(ROOMS, "rooms", seed=3)
    assert found.refusal is None and found.survey is None and found.way is not None
    assert found.shapes["planes"] == 2 and found.scene is not None
    scene, other = (load_missions(ROOMS, "rooms", seed=seed).scene() for seed in (3, 4))
    np.testing.assert_array_equal(found.scene.boxes.position, scene.boxes.position)
    assert not np.array_equal(found.scene.boxes.position, other.boxes.position)
    with pytest.raises(ConfigError, match="--seed must be from 0"):
        check_world(ROOMS, "rooms", seed=-1)


@pytest.mark.whole
def test_an_evaluation_and_a_training_warn_as_the_check_does(tmp_path: Path) -> None:
    tight = str(corridor(tmp_path, 1.4, length=60.0))
    whole = check_world(ROOMS, tight).warnings
    assert len(whole) == 2
    assert warn_of_missions(ROOMS, load_missions(ROOMS, tight)) == whole
    there = dataclasses.replace(ROOMS, world=WorldConfig(name=tight))
    assert warn_of_training(there) == whole[:1]
    assert warn_of_missions(ROOMS, load_missions(ROOMS, "rooms")) == () == warn_of_training(ROOMS)
    assert warn_of_training(dataclasses.replace(ROOMS, world=WorldConfig(name=str(tmp_path / "gone.xml")))) == ()
    assert warn_of_missions(there, load_missions(there, str(corridor(tmp_path, WIDE)))) == ()


def test_random_worlds_much_larger_than_those_of_training_are_warned_of() -> None:
    (warning,) = warn_of_missions(ROOMS, MissionSet("medium", None, None))  # type: ignore[arg-type]
    assert (
        warning.startswith("the flight volume of 110 × 110 × 25 m is much larger than those") and "36 × 36" in warning
    )
    larger = dataclasses.replace(ROOMS, world=WorldConfig(name="mixed"))
    assert warn_of_training(larger, ROOMS) == (warning,)
    assert warn_of_training(ROOMS, larger) == () == warn_of_training(larger)


def test_costs_grow_with_shapes_and_pixels(tmp_path: Path) -> None:
    few = estimate_cost(ROOMS, load_scene(corridor(tmp_path, WIDE)))
    balls = "".join(f'<geom size=".1" pos="{x} 1 1"/>' for x in range(4, 10))
    many = estimate_cost(ROOMS, load_scene(corridor(tmp_path, WIDE, balls)))
    fine = dataclasses.replace(ROOMS, camera=dataclasses.replace(ROOMS.camera, width=64))
    assert many.picture_us > few.picture_us and many.world_bytes > few.world_bytes
    assert many.training_bytes > few.training_bytes
    assert estimate_cost(fine, load_scene(corridor(tmp_path, WIDE))).picture_us == 2 * few.picture_us
