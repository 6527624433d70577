"""The map of when an event camera is worth it: which rows there are, how they are flown, compared and drawn."""

from __future__ import annotations

import dataclasses
import json
import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import success
import worth
from edqn_jax.config import Config
from edqn_jax.config.loading import apply_layer
from edqn_jax.config.registry import SENSORS
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.learn.policy import Policy
from edqn_jax.sim.physics.drone import Flight
from edqn_jax.sim.scene.scene import take_scene
from edqn_jax.sim.sensors.built_in import CHANGE_SCALE
from edqn_jax.sim.sensors.sensor import nearness_image
from edqn_jax.sim.task.env import scene_of
from edqn_jax.sim.task.flights import Record
from edqn_jax.sim.worlds import rooms
from tests.support.benchmarks.untrained_runs import SMALL, untrained
from tests.support.policies import CONFIG
from tests.support.registries import keep_as_they_are
from worth_parts import flown, own, table, traffic
from worth_parts.axes import AXES, Place, config_of, flown_of, places_of
from worth_parts.picture import HATCH, PARTIAL, draw_map

LOOKS = AXES["looks"]


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    keep_as_they_are(monkeypatch)
    own.register()
    own.register()  # once more is no error


def row(sensor: str, rate: float, flown: dict[str, float] | None = None, **other: object) -> success.Row:
    """A row of looks in medium worlds, of two seeds and 200 missions; each condition with its rate of success."""
    seeds = {
        name: ["1" * round(200 * one) + "2" * (200 - round(200 * one)) for _ in range(2)]
        for name, one in (flown or dict.fromkeys(LOOKS.flown, rate)).items()
    }
    shared = {"benchmark": "worth", "axis": "looks", "world": "medium", "trained": "plaid", "sensor": sensor}
    numbers = {"missions": 200, "test_seed": 46, "decisions": 1000, "seeds": [0, 1], "flown": seeds}
    return {**shared, **numbers, **other}


def counted(width: int, rates: list[float]) -> success.Row:
    size = {"width": width, "height": traffic.SIZES[width]}
    return {
        **{"benchmark": "worth", "axis": "bytes", "world": "medium", "look": "drawn", "policy": "x", **size},
        **{"missions": 2, "test_seed": 46, "events_per_second": {"0.05": rates, "0.2": rates}},
    }


# -------------------------------------------------------------------------------------------- rows


def test_controls_that_see_no_look_are_trained_and_flown_once_for_all_looks() -> None:
    places = places_of(LOOKS, LOOKS.worlds, list(LOOKS.trained), list(LOOKS.sensors))
    assert len(places) == len(set(places)) == 2 * (2 + 4 * 2)
    assert [place.trained for place in places if place.sensor == "depth"] == ["plaid", "plaid"]
    drawn = places_of(LOOKS, ["rooms"], ["drawn"], ["blind", "events"])
    assert drawn == [Place("rooms", "plaid", "blind"), Place("rooms", "drawn", "events")]
    assert list(flown_of(LOOKS, "blind")) == ["plaid"] and set(flown_of(LOOKS, "events")) >= {"bricks", "posters"}
    assert len(flown_of(AXES["age"], "depth")) == 12  # who sees balls sees how late they are


@pytest.mark.parametrize("name", AXES)
def test_sensors_of_an_axis_have_equal_decisions_and_equal_memory(name: str) -> None:
    axis = AXES[name]
    places = places_of(axis, axis.worlds, list(axis.trained), list(axis.sensors))
    by_world: dict[str, set[tuple[object, ...]]] = {}
    for place in places:
        config = config_of(axis, place, [])
        same = config.train.total_steps, config.agent, config.drone, config.world
        by_world.setdefault(place.world, set()).add(same)
    assert all(len(found) == 1 for found in by_world.values())


def test_late_balls_come_at_25_decisions_a_second() -> None:
    config = config_of(AXES["age"], Place("court", "0.3 to 1 s", "depth-late-1"), SMALL)
    assert config.drone.physics_steps * config.drone.physics_dt_s == pytest.approx(0.04)
    assert config.world.ball_seconds == (0.3, 1.0) and config.world.ball_radii_m == (0.15, 0.3)


def test_shade_is_trained_and_flown_without_and_with_cast_shadows() -> None:
    axis = AXES["shade"]
    configs = [config_of(axis, Place("medium", name, "frame-pair"), SMALL) for name in axis.trained]
    assert [config.camera.shadows for config in configs] == [False, True]
    assert {(config.camera.ambient, config.surface.pattern) for config in configs} == {(0.01, "plaid")}
    assert all(config.exposure.real and config.light.least_lux == 10_000 for config in configs)
    flown = flown_of(axis, "events")
    assert [flown[name]["camera"]["shadows"] for name in axis.trained] == [False, True]
    trained = configs[list(axis.trained).index("shadows")]
    alone = {name: apply_layer(trained, flown[name], name) for name in ("no shading", "dim sun")}
    assert not any(config.camera.shadows for config in alone.values())
    assert [config.camera.ambient for config in alone.values()] == [1.0, 0.01]
    assert [config.light.most_lux for config in alone.values()] == [10_000, 100]
    places = places_of(axis, ["medium"], list(axis.trained), list(axis.sensors))
    assert (
        len(places) == 2 + 3 * 2 and len(flown_of(axis, "depth")) == 1
    )  # depth and nothing do not change in the shade


def test_wires_are_flown_with_two_cameras_of_which_one_has_four_times_the_pixels() -> None:
    axis = AXES["fine"]
    coarse, fine = (config_of(axis, Place("wires", name, "events"), []) for name in axis.trained)
    assert fine.camera.width * fine.camera.height == 4 * coarse.camera.width * coarse.camera.height
    width, height = coarse.camera.width, coarse.camera.height
    same = dataclasses.replace(fine, camera=dataclasses.replace(fine.camera, width=width, height=height))
    assert same == coarse and coarse.camera.mount == "body" and coarse.env.speed_m_s == 8
    places = places_of(axis, axis.worlds, list(axis.trained), ["blind", "depth"])
    assert [place.sensor for place in places] == ["blind", "depth", "depth"]  # pixels are nothing to who sees nothing


def test_trunks_of_wires_keep_apart_and_wires_hang_level_between_floor_and_ceiling() -> None:
    scenes = jax.vmap(own.sample_wires)(jax.random.split(jax.random.key(0), 16))
    wires, trunks = scenes.boxes, scenes.cylinders
    (low, high), (thin, thick) = own.WIRE_HEIGHT, own.WIRE_RADIUS
    assert bool(jnp.all((wires.position[..., 2] >= low) & (wires.position[..., 2] <= high)))
    assert bool(jnp.all((wires.half[..., 1] >= thin) & (wires.half[..., 1] <= thick)))
    assert bool(jnp.all(wires.half[..., 1] == wires.half[..., 2]))
    assert bool(jnp.all(2 * wires.half[..., 0] >= own.WIRE_LENGTH[0]))
    assert float(jnp.std(wires.yaw)) > 0.5 and float(jnp.std(wires.position[..., 0])) > 5  # all ways, all over
    standing = trunks.radius > 0
    assert bool(jnp.all(standing.sum(axis=1) > 40))
    apart = jnp.linalg.norm(trunks.position[:, :, None, :2] - trunks.position[:, None, :, :2], axis=-1)
    apart = apart - trunks.radius[:, :, None] - trunks.radius[:, None]
    pairs = standing[:, :, None] & standing[:, None] & ~jnp.eye(own.TRUNKS, dtype=bool)
    assert float(jnp.where(pairs, apart, jnp.inf).min()) >= own.TRUNK_GAP - 1e-4  # in float32, of 40 m
    tops = trunks.position[..., 2] + trunks.half_height
    assert bool(jnp.all(jnp.where(standing, tops, own.WIRES_M[2]) == own.WIRES_M[2]))


def test_courtyards_are_the_rooms_of_the_same_key_of_which_half_have_a_roof_in_place_of_the_ceiling() -> None:
    keys = jax.random.split(jax.random.key(0), 16)
    yards, houses = jax.vmap(own.sample_courtyards)(keys), jax.vmap(rooms.sample_rooms)(keys)
    walls = houses.boxes.yaw.shape[1]
    np.testing.assert_array_equal(yards.boxes.position[:, :walls], houses.boxes.position)
    np.testing.assert_array_equal(yards.start, houses.start)
    assert yards.planes.normal.shape == (16, 1, 3) and bool(jnp.all(yards.planes.normal[..., 2] == 1))
    at, half = np.asarray(yards.boxes.position[:, walls:]), np.asarray(yards.boxes.half[:, walls:])
    there = half[..., 0] > 0
    assert 0.3 < there.mean() < 0.7
    low, high = at - half, at + half
    np.testing.assert_allclose(
        np.where(there, low[..., 2], 0), np.where(there, yards.volume[:, None, 1, 2], 0), atol=1e-5
    )
    # The roofs of a world do not overlap: together they are as large as what they cover.
    grid = np.stack(np.meshgrid(*2 * [np.arange(0.5, rooms.SIDE)]), axis=-1).reshape(-1, 1, 2)
    covering = ((grid > low[:, None, :, :2]) & (grid < high[:, None, :, :2])).all(axis=-1).sum(axis=-1)
    assert covering.max() == 1
    areas = np.where(there, 4 * half[..., 0] * half[..., 1], 0).sum(axis=1)
    np.testing.assert_allclose(areas, covering.sum(axis=1), rtol=0.1)  # of a grid of 1 m


def test_who_sees_nothing_stands_beside_both_cameras_and_true_depth_beside_its_own_alone() -> None:
    axis = AXES["fine"]
    coarse, fine = axis.trained
    first, all_flown = dict.fromkeys(list(axis.flown)[:1], 0.25), dict.fromkeys(axis.flown, 0.75)
    at = {"axis": "fine", "world": "wires"}
    rows = [row(control, 0, first, **at, trained=coarse) for control in ("blind", "depth")]
    rows += [row("events", 0, all_flown, **at, trained=camera) for camera in (coarse, fine)]
    beside = {(cell.trained, cell.flown): set(cell.arrived) for cell in table.cells_of(rows, axis)}
    assert beside == {(coarse, lux): {"blind", "depth", "events"} for lux in axis.flown} | {
        (fine, lux): {"blind", "events"} for lux in axis.flown
    }


def test_cameras_of_one_size_average_equally_many_pixels() -> None:
    axis, usual = AXES["size"], config_of(AXES["dark"], Place("medium", "8 m/s", "frames"), SMALL)
    events, frames = (config_of(axis, Place("medium", "8 m/s", sensor), SMALL) for sensor in ("events", "frames"))
    assert (events.events.sensor_pixels, events.events.threshold) == (117, 0.2)
    more, less = frames.exposure, usual.exposure
    assert (more.full_well_e / less.full_well_e, more.sensitivity_e_lux_s / less.sensitivity_e_lux_s) == (117, 117)
    assert (more.read_noise_e / less.read_noise_e) ** 2 == pytest.approx(117)
    assert frames.light == events.light == usual.light


def test_controls_of_another_axis_stand_beside_sensors_that_differ_alone() -> None:
    axis = AXES["size"]
    at = {"axis": "dark", "trained": "8 m/s"}
    first = dict.fromkeys(list(axis.flown)[:1], 0.25)
    rows = [row("blind", 0.25, first, **at), row("frames", 0.5, dict.fromkeys(axis.flown, 0.5), **at)]
    assert table.cells_of(table.rows_of(rows, "size"), axis) == []
    rows.append(row("events", 0.75, dict.fromkeys(axis.flown, 0.75), **at | {"axis": "size"}))
    cells = table.cells_of(table.rows_of(rows, "size"), axis)
    assert [set(cell.arrived) for cell in cells] == [{"blind", "events"}] * len(axis.flown)
    assert {cell.arrived["blind"].mean() for cell in cells} == {0.25}
    assert "blind" not in axis.sensors and "| medium | 8 m/s | 0.1 lux | 25.0 (" in table.tables(rows, {"size": cells})


def test_events_that_need_less_light_stand_beside_the_frames_of_another_axis() -> None:
    axis, place = AXES["bandwidth"], Place("medium", "8 m/s", "events")
    usual, quick = (config_of(AXES[name], place, SMALL) for name in ("size", "bandwidth"))
    assert quick.events.reference_lux == 0.1 * usual.events.reference_lux
    assert dataclasses.replace(quick, events=usual.events) == usual
    rates = {"frames": 0.5, "frame-pair": 0.25, "events": 0.75}
    rows = [
        row(sensor, rate, dict.fromkeys(axis.flown, rate), axis="size", trained=trained)
        for sensor, rate in rates.items()
        for trained in axis.trained
    ]
    assert table.cells_of(table.rows_of(rows, "bandwidth"), axis) == []
    rows.append(row("events", 1.0, dict.fromkeys(axis.flown, 1.0), axis="bandwidth", trained="8 m/s"))
    cells = table.cells_of(table.rows_of(rows, "bandwidth"), axis)
    assert [cell.trained for cell in cells] == ["8 m/s"] * len(axis.flown)  # at 4 m/s there are borrowed rows alone
    assert {sensor: cells[0].arrived[sensor].mean() for sensor in rates} == rates | {"events": 1.0}
    assert not cells[0].missing
    assert "| frames | frame-pair |" in table.tables(rows, {"bandwidth": cells})
    without = [each for each in rows if each["sensor"] != "frame-pair"]
    assert table.cells_of(table.rows_of(without, "bandwidth"), axis)[0].missing == ["frame-pair"]


@pytest.mark.parametrize("name", AXES)
def test_no_axis_trains_what_it_borrows(name: str) -> None:
    axis = AXES[name]
    assert not axis.sensors.keys() & axis.borrowed.keys()
    assert all(sensor in AXES[other].sensors for sensor, other in axis.borrowed.items())


def test_learners_stand_in_one_table_with_both_trainings_of_dqn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rates = {"pqn": 0.25, "dqn": 0.5, "imitation": 1.0, "teacher": 1.0}
    flown = dict.fromkeys(AXES["age"].flown, 0.0)
    at = {"axis": "age", "world": "court", "trained": "0.3 to 1 s"}
    rows = {
        f"learners/{name}/a-b-{name}.json": row("events", rate, dict.fromkeys(flown, rate), **at)
        for name, rate in rates.items()
    }
    taught = {"frames": 0.3, "frame-pair": 0.4, "frame-pair@120": 0.5}
    rows |= {
        f"learners/taught/a-b-{sensor}.json": row(sensor, rate, dict.fromkeys(flown, rate), **at)
        for sensor, rate in taught.items()
    }
    rows["learners/taught_teacher/a-b-c.json"] = row("depth", 0.9, dict.fromkeys(flown, 0.9), **at)
    one_teacher = {"depth": 0.8, "events": 0.6, "frames": 0.7}
    rows |= {
        f"learners/one_teacher/a-b-{sensor}.json": row(sensor, rate, dict.fromkeys(flown, rate), **at)
        for sensor, rate in one_teacher.items()
    }
    of_map = {"events": 0.7, "blind": 0.1, "frames": 0.2, "frame-pair": 0.4, "frame-pair@120": 0.8}
    rows |= {f"map/a-b-{name}.json": row(name, rate, dict.fromkeys(flown, rate), **at) for name, rate in of_map.items()}
    for name, one in rows.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(json.dumps(one))
    script = runpy.run_path(str(Path(__file__).parents[2] / "scripts" / "learners.py"))
    script["main"](tmp_path / "learners", tmp_path / "map")
    first, second, third = ([*text.splitlines()] for text in capsys.readouterr().out.split("\n\n"))
    assert len(first) == len(second) == 8 and "DQN, two trainings" in first[0]
    cells = ["6", "0.3 to 0.5 s", "10.0", "25.0", "60.0", "100.0", "100.0", "**40.0**", "**35.0**"]
    assert [cell.strip().partition(" (")[0] for cell in first[2].strip("|").split("|")] == cells
    assert "pair, 120 a second ahead of DQN by" in second[0]
    cells = ["12", "0.5 to 1 s", "90.0", "30.0", "40.0", "50.0", "**10.0**", "0.0", "**-30.0**"]
    assert [cell.strip().partition(" (")[0] for cell in second[7].strip("|").split("|")] == cells
    cells = ["6", "0.3 to 0.5 s", "80.0", "60.0", "70.0", "**-10.0**", "**20.0**"]
    assert [cell.strip().partition(" (")[0] for cell in third[2].strip("|").split("|")] == cells


def test_rows_of_two_learners_are_not_compared() -> None:
    rows = [
        row(sensor, 0.5, options=f"agent: {{learner: {name}}}")
        for sensor, name in (("events", "dqn"), ("frames", "dqn"))
    ]
    assert len(table.rows_of(rows, "looks")) == 2
    rows.append(row("frame-pair", 0.5, options="agent: {learner: pqn}"))
    with pytest.raises(ConfigError, match="rows of the axis looks have other learners than each other"):
        table.rows_of(rows, "looks")


def test_a_camera_with_a_clock_has_its_rate_and_latency_and_counts_as_frames() -> None:
    config = config_of(AXES["age"], Place("court", "0.3 to 1 s", "frame-pair@60"), SMALL)
    assert (config.env.sensor, config.exposure.rate_hz, config.exposure.latency_s) == ("frame-pair", 60, 0.015)
    assert table.verdict_of(["frame-pair@60", "frame-pair@30"], ["events", "frame-pair@30", "frame-pair@60"]) == (
        "frames or pairs"
    )


def test_what_an_axis_has_not_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in (
        (["--axis", "looks", "--sensors", "ranges"], "--sensors must be of what the axis has (blind, depth, events,"),
        (["--axis", "bytes", "--worlds", "court"], "--worlds must be of what the axis has (sparse,"),
        ([], "give either --axis, whose rows are measured, or --report"),
        (["--axis", "bytes", "--widths", "100"], "--widths must be of 32, 64, 128, 346"),
    ):
        with pytest.raises(SystemExit):
            worth.parse(["--out", "x", *words])
        assert said in capsys.readouterr().err
    assert worth.parse(["--out", "x", "--axis", "bytes"]).missions == 32
    assert worth.parse(["--out", "x", "--axis", "age"]).test_seed == 46


def test_a_row_that_another_process_measures_is_left_to_it(tmp_path: Path) -> None:
    taken, free = tmp_path / "a-b-1.json", tmp_path / "a-b-2.json"
    wanted = [success.Wanted(file, lambda: {"row_seconds": 1.0}, says=lambda row: "measured") for file in (taken, free)]
    with success._claim(taken) as ours:
        assert ours
        rows: list[success.Row] = []
        assert success.measure(wanted, rows, 1e12) == 1
        assert len(rows) == 1 and free.is_file() and not taken.is_file()
    assert success.measure(wanted, rows, 1e12) == 0 and len(rows) == 2


# ----------------------------------------------------------------------------------------- flights


def test_looks_that_one_program_can_fly_are_flown_together_and_told_apart_again(monkeypatch) -> None:
    courses = []

    def fly(config: Config, course: object, params: object, **_: object) -> object:
        courses.append(course)
        count = course.missions.scene.shape[0]  # type: ignore[attr-defined]
        arrived = np.arange(count) % 3 + params  # type: ignore[operator]
        return type("Flights", (), {"outcome": arrived})

    monkeypatch.setattr(flown, "fly_on_all_devices", fly)
    config = config_of(LOOKS, Place("medium", "drawn", "events"), SMALL)
    policies = [Policy(config, params) for params in (0, 1)]  # type: ignore[arg-type]
    layers = {look: LOOKS.flown[look] for look in ("plaid", "bricks", "wood")}
    found = flown.outcomes_of(config, policies, layers, 4, 3)
    assert [course.missions.scene.shape[0] for course in courses] == [4, 4, 8, 8]  # plaid has no surfaces
    assert found == {"plaid": ["0120", "1231"], "bricks": ["0120", "1231"], "wood": ["1201", "2312"]}
    # The second half are the worlds of wood, the same as those of bricks but for the look.
    alone = flown.with_any_pattern(load_missions(with_look(config, "wood"), "medium", 4, 3).env_params)
    for mission in (0, 3):
        one, two = (scene_of(course, jnp.int32(at)) for course, at in ((courses[-1], 4 + mission), (alone, mission)))
        jax.tree.map(np.testing.assert_array_equal, one, two)
    bricks = take_scene(courses[-1].pool, 0).boxes
    np.testing.assert_array_equal(bricks.position, take_scene(courses[-1].pool, 4).boxes.position)
    assert not np.array_equal(bricks.surface.numbers, take_scene(courses[-1].pool, 4).boxes.surface.numbers)


def with_look(config: Config, look: str) -> Config:
    return dataclasses.replace(config, surface=dataclasses.replace(config.surface, pattern=look))


@pytest.mark.slow
def test_a_row_is_trained_flown_and_reported(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(worth, "use_cpu_devices", lambda count: None)
    monkeypatch.setattr(success, "train_seeds", untrained)
    words = ["--out", str(tmp_path), "--axis", "age", "--seeds", "2", "--missions", "3", "--test-seed", "1"]
    few = [*SMALL, "--env.max-decisions", "12"]
    assert worth.main([*words, "--sensors", "depth", "depth-late-1", "--row-seconds", "1", "--", *few]) == 0
    assert '"sensor": "depth-late-1", "success": {"0.3 to 0.4 s, 6 m/s": 0.0' in capsys.readouterr().err
    rows = [json.loads(file.read_text()) for file in tmp_path.glob("court-*.json")]
    assert len(rows) == 2 and all(len(row["flown"]) == 12 for row in rows)
    assert all(len(seeds) == 2 and {len(seed) for seed in seeds} == {3} for seeds in rows[0]["flown"].values())
    assert worth.main(["--out", str(tmp_path), "--report"]) == 0
    assert "test worlds 3 to 5), 256 decisions a seed" in capsys.readouterr().out
    assert (tmp_path / "worth.png").stat().st_size > 10_000


def test_depth_that_is_late_shows_the_picture_of_an_observation_before() -> None:
    config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, sensor="depth-late-2"))
    sensor, scene = SENSORS.get("depth-late-2"), load_missions(CONFIG, "medium", 1).scene()
    start = np.asarray(scene.start)
    places = [start + np.array([4.0 * n, 0.0, 0.0], np.float32) for n in range(4)]
    upright = jnp.array([1.0, 0.0, 0.0, 0.0])
    memory, shown = sensor.at_rest(config, jax.random.key(0)), []
    for place in places:
        poses = Flight(position=jnp.asarray(place)[None], quaternion=upright[None], velocity=jnp.zeros((1, 3)))
        picture, memory = sensor.show(config, scene, poses, memory, jax.random.key(1))
        shown.append(picture[0])
    true = [nearness_image(config, scene, jnp.asarray(place), upright) for place in places]
    for picture, expected in zip(shown, (true[0], true[0], true[0], true[1]), strict=True):
        np.testing.assert_allclose(picture, expected, atol=1e-5)
    assert np.abs(np.asarray(true[1] - true[0])).max() > 0.01


def test_the_difference_of_a_pair_counts_thresholds_as_events_do_and_hides_the_newest_frame() -> None:
    scene = load_missions(CONFIG, "medium", 1).scene()
    moved = scene.start + jnp.array([[0.0, 0.0, 0.0], [0.6, 0.2, 0.1]])
    poses = Flight(position=moved, quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]] * 2), velocity=jnp.zeros((2, 3)))
    shown = {}
    for name in ("frame-pair", "frame-difference"):
        config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, sensor=name))
        sensor = SENSORS.get(name)
        shown[name] = np.asarray(
            sensor.show(config, scene, poses, sensor.at_rest(config, jax.random.key(0)), jax.random.key(1))[0]
        )
        assert shown[name].shape == sensor.shape(config)
    brighter, darker = np.expm1(shown["frame-difference"]) * CONFIG.events.threshold
    np.testing.assert_allclose(brighter - darker, CHANGE_SCALE * shown["frame-pair"][1], atol=1e-5)
    assert (brighter > 0.01).any() and (darker > 0.01).any() and not (brighter * darker).any()


# ------------------------------------------------------------------------------------------ report


def cell(**rates: float) -> table.Cell:
    arrived = {
        name.replace("_", "-"): np.arange(400).reshape(1, 400).repeat(3, 0) < 400 * rate for name, rate in rates.items()
    }
    return table.Cell("medium", "plaid", "wood", arrived)


@pytest.mark.parametrize(
    ("rates", "said"),
    [
        ({"blind": 0.99, "events": 0.9, "frames": 0.7, "frame_pair": 0.6}, "events"),
        ({"events": 0.7, "frames": 0.9, "frame_pair": 0.7}, "frames"),
        ({"events": 0.7, "frames": 0.9, "frame_pair": 0.9}, "frames or pairs"),
        ({"events": 0.9, "frames": 0.9, "frame_pair": 0.5}, "no difference"),
        ({"events": 1.0, "frames": 0.5}, "events"),
        ({"blind": 0.9, "depth": 0.9, "depth_late_1": 0.5}, "depth"),
        ({"blind": 0.9, "events": 0.5}, "–"),
    ],
)
def test_a_sensor_leads_where_its_difference_to_every_other_is_above_0(rates: dict[str, float], said: str) -> None:
    one = cell(**rates)
    assert table.verdict_of(table.best_of(one), one.rivals) == said


def test_the_table_shows_blind_sensors_and_depth_and_refuses_unequal_budgets() -> None:
    one = {"plaid": 0.5}
    rows = [row("depth", 0, one), row("blind", 0, {"plaid": 0.25}), row("events", 0.9), row("frames", 0.6)]
    said = table.tables(rows, table.all_cells(rows))
    assert "| world | trained | flown | blind | events | frames | depth | leads | events ahead by |" in said
    assert "2 seeds × 200 missions a cell, the same for all sensors (test worlds 9200 to 9399), 1,000 decisions" in said
    (wood,) = [line for line in said.splitlines() if "| wood |" in line]
    # Who sees no look has flown one of them, and stands in all.
    assert "| 25.0 (" in wood and "| 50.0 (" in wood
    assert "| events (not flown: frame-pair, frame-difference) | 30.0 (" in wood  # who leads is not said of all
    assert said.count("| medium |") == 6  # no cell of drawn training, of which there are no rows but the controls'
    with pytest.raises(ConfigError, match="the axis looks in medium have other decisions than each other"):
        table.all_cells([*rows, row("frame-pair", 0.5, decisions=2000)])
    longer = [row(sensor, 0.5, world="rooms", decisions=2000) for sensor in ("events", "frames")]
    said = table.tables([*rows, *longer], table.all_cells([*rows, *longer]))
    assert "in medium 1,000, in rooms 2,000 decisions a seed" in said


def test_an_axis_of_which_controls_alone_were_flown_has_no_table() -> None:
    assert table.tables([blind := row("blind", 0.2)], table.all_cells([blind])) == "There are no rows."


def test_the_map_has_a_panel_for_each_axis_and_says_what_its_colours_are(tmp_path: Path) -> None:
    rows = [row("events", 0.9), row("frames", 0.6), counted(32, [500.0, 7000.0])]
    figure = draw_map(rows, table.all_cells(rows), tmp_path / "map.png")
    looks, rates = figure.axes
    assert [text.get_text() for text in looks.get_xticklabels()] == list(LOOKS.flown)
    assert [text.get_text() for text in rates.get_yticklabels()] == ["medium, drawn, 32 × 24"]
    (legend,) = figure.legends
    said = {text.get_text() for text in legend.get_texts()}
    assert said == {"events lead (bytes: events cost less)", "no difference", PARTIAL}
    assert {patch.get_hatch() for patch in looks.patches} == {HATCH}
    whole = [*rows, row("frame-pair", 0.5), row("frame-difference", 0.5)]
    looks, _ = draw_map(whole, table.all_cells(whole), tmp_path / "whole.png").axes
    assert {patch.get_hatch() for patch in looks.patches} == {None}
    for blind, said in ((0.1, "events"), (0.95, "blind is ahead")):
        seen = [*whole, row("blind", blind)]
        looks, _ = draw_map(seen, table.all_cells(seen), tmp_path / "blind.png").axes
        assert {text.get_text().splitlines()[-1] for text in looks.texts} == {said}
    assert (tmp_path / "map.png").is_file()
    with pytest.raises(ConfigError, match="there are no rows of this benchmark"):
        draw_map([], {}, tmp_path / "none.png")


# ------------------------------------------------------------------------------------------- bytes


def test_the_break_even_is_the_rate_at_which_frames_cost_the_bytes_of_the_events() -> None:
    even, low, high = traffic.break_even(counted(32, [768.0, 1536.0]), "0.2", 4)
    assert even == pytest.approx(6.0) and low == pytest.approx(4.0) and high == pytest.approx(8.0)
    assert traffic.break_even(counted(32, [768.0, 1536.0]), "0.2", 8)[0] == pytest.approx(12.0)


def recorded(steps: int) -> object:
    """Flights of one mission that flies along x by 0.08 m in each physics step."""
    position = np.array([5.0, 20.0, 4.0]) + np.arange(30)[:, None] * np.array([0.08, 0.0, 0.0])
    quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (30, 1))
    fields = {"position": position, "quaternion": quaternion, "velocity": np.zeros((30, 3))}
    none = dict.fromkeys(("clearance", "action", "reward"))
    record = Record(**{name: np.stack([values] * 2) for name, values in fields.items()}, **none)  # type: ignore[arg-type]
    return type("Flights", (), {"physics_steps": np.array([steps, 5]), "get_record": lambda self: record})()


def test_moments_are_within_flights_and_poses_between_their_steps() -> None:
    flights = recorded(20)
    moments = traffic.moments_of(CONFIG, flights, 0)
    assert [mission for mission, _ in moments] == [0] * traffic.MOMENTS  # the other flight is too short
    assert all(0 <= first <= 20 - 2 - traffic.WINDOW_STEPS for _, first in moments)
    poses = traffic.poses_between(flights.get_record(), 0, 3, 4, 0.02)  # type: ignore[attr-defined]
    np.testing.assert_allclose(poses.position[:, 0], 5.0 + 0.08 * (3 + np.arange(41) / 4), rtol=1e-6)
    assert poses.time is not None
    np.testing.assert_allclose(np.asarray(poses.time)[[0, -1]], [0.08, 0.28], rtol=1e-6)


def test_events_are_fewer_with_a_higher_contrast_and_none_where_nothing_moves() -> None:
    config = dataclasses.replace(CONFIG, events=dataclasses.replace(CONFIG.events, law="esim"))
    flights, course = recorded(25), load_missions(config, "medium", 1)
    rates = traffic.event_rates(config, course, flights, traffic.moments_of(config, flights, 0))
    assert rates.shape == (1, len(traffic.CONTRASTS)) and rates[0, 0] > 10
    assert (np.diff(rates[0]) < 0).all()
    flights.get_record().position[:] = [5.0, 20.0, 4.0]  # type: ignore[attr-defined]
    assert not traffic.event_rates(config, course, flights, [(0, 0)]).any()
