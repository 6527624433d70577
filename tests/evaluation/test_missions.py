"""From the name of a world to missions."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from edqn_jax.config import Config
from edqn_jax.config.loading import make_config
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import load_missions, missions_of_runs, run_missions
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.scene.mjcf import load_scene, resolve_world, write_scene
from edqn_jax.sim.scene.scene import take_scene
from edqn_jax.sim.worlds import families
from tests.support.small_worlds import WITHOUT_A_WAY, small_world

pytestmark = pytest.mark.whole

CONFIG = Config()


@pytest.mark.slow
def test_one_mission_in_a_file_is_its_own():
    course = load_missions(CONFIG, "paper")
    np.testing.assert_allclose(course.env_params.missions.start, [[1, 1, 3]])
    np.testing.assert_allclose(course.env_params.missions.goal, [[90, 90, 10]])
    assert course.mjcf() == [resolve_world("paper").read_text()]


@pytest.mark.slow
def test_many_missions_in_a_file_start_all_over_and_go_to_its_goal():
    missions = load_missions(CONFIG, "paper", 50).env_params.missions
    np.testing.assert_allclose(missions.goal, np.tile([90, 90, 10], (50, 1)))
    assert np.all(np.std(np.asarray(missions.start), axis=0) > [20, 20, 4])  # uniform: 31, 31 and 6.4 m
    others = load_missions(CONFIG, "paper", 50, seed=1).env_params.missions
    assert not np.any(np.all(missions.start == others.start, axis=1))


@pytest.mark.slow
def test_start_and_goal_may_be_given():
    missions = load_missions(CONFIG, "paper", start=(2, 3, 4), goal=(3, 100, 20)).env_params.missions
    np.testing.assert_allclose(missions.start, [[2, 3, 4]])
    np.testing.assert_allclose(missions.goal, [[3, 100, 20]])
    many = load_missions(CONFIG, "paper", 5, goal=(3, 100, 20)).env_params.missions
    np.testing.assert_allclose(many.goal, np.tile([3, 100, 20], (5, 1)))


@pytest.mark.parametrize(("fraction", "near"), [(0.0, 0.5), (0.25, 0.5), (0.75, 0.75), (1.0, 1.0)])
@pytest.mark.slow
def test_validation_begins_where_training_does(fraction: float, near: float) -> None:
    """At least half of it near the start; all of it where training begins nowhere else."""
    config = make_config(
        "paper", world={"own_start_fraction": fraction, "missions": 32}, train={"validation_missions": 40}
    )
    missions = run_missions(config)
    assert missions.near_start.mean() == near
    starts = np.asarray(missions.validation.env_params.missions.start)
    apart = np.abs(starts[missions.near_start] - [1.0, 1.0, 3.0]).max(axis=1)
    assert (apart <= 1.0 + 1e-3).all() and len(np.unique(starts, axis=0)) == 40


def test_random_worlds_are_the_test_split_and_each_has_one_mission():
    course = load_missions(CONFIG, "sparse", 4, seed=2)
    pool, missions = course.env_params.pool, course.env_params.missions
    assert missions.scene.tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(missions.start, pool.start)
    expected = families.random_pool("sparse", families.world_keys("test", 4, first=8))
    np.testing.assert_array_equal(pool.boxes.position, expected.boxes.position)


def test_a_random_world_as_mjcf_is_the_world_that_was_flown():
    course = load_missions(CONFIG, "sparse", 4, seed=2)
    texts = course.mjcf()
    assert len(texts) == 4
    model = mujoco.MjSpec.from_string(texts[3]).compile()
    np.testing.assert_allclose(model.site("start").pos, course.env_params.pool.start[3], atol=1e-5)


def inside_a_block() -> tuple[float, float, float]:
    x, y, z = np.asarray(load_scene(resolve_world("paper")).boxes.position[0])
    return float(x), float(y), float(z)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"name": "papper"}, "there is no scene 'papper'"),
        ({"name": "nowhere/file.xml"}, "there is no scene file 'file.xml'"),
        ({"name": "paper", "missions": 0}, "missions must be at least 1"),
        ({"name": "paper", "seed": -1}, "--seed must be from 0"),
        ({"name": "sparse", "missions": 4, "seed": 2**30}, "--seed must be from 0"),
        ({"name": "paper", "start": (float("nan"), 1, 3)}, "--start must be three finite numbers, metres, not nan 1 3"),
        ({"name": "paper", "goal": (1, 1, float("inf"))}, "--goal must be three finite numbers, metres, not 1 1 inf"),
        (
            {"name": "paper", "start": (1, 1, 3), "goal": (1, 1, 3)},
            "is 0.00 m from the goal, where a drone has arrived",
        ),
        ({"name": "paper", "start": (89, 90, 10)}, r"is 1.00 m from the goal, .* within 2 m; move either"),
        ({"name": "paper", "start": (1, 1, 30)}, "lies outside the flight volume"),
        ({"name": "paper", "missions": 3, "start": (1, 1, 3)}, "all flights would be equal"),
        ({"name": "sparse", "missions": 4, "goal": (5, 5, -1)}, "test world 0"),
    ],
)
@pytest.mark.slow
def test_what_cannot_be_flown_is_a_sentence(arguments, says):
    with pytest.raises(ConfigError, match=says):
        load_missions(CONFIG, **arguments)


@pytest.mark.parametrize("missions", [1, 3])
@pytest.mark.slow
def test_a_goal_inside_a_wall_names_the_wall(missions):
    with pytest.raises(ConfigError, match=r"the goal .* lies inside '\w+'"):
        load_missions(CONFIG, "paper", missions, goal=inside_a_block())


def test_what_cannot_be_trained_in_is_refused_before_anything_is_compiled(tmp_path):
    shut, vast = tmp_path / "shut.xml", tmp_path / "vast.xml"
    write_scene(WITHOUT_A_WAY["wall across"].scene, shut)
    scene = small_world().scene
    write_scene(dataclasses.replace(scene, volume=scene.volume + np.array([[0], [440.0]])), vast)
    with pytest.raises(ConfigError, match="every path is blocked"):
        run_missions(make_config(str(shut)))
    with pytest.raises(ConfigError, match="million cells of 0.5 m, and a way is searched in at most 40 million"):
        run_missions(make_config(str(vast)))


def test_a_start_inside_a_wall_names_the_wall():
    with pytest.raises(ConfigError, match=r"the start .* lies inside '\w+'"):
        load_missions(CONFIG, "paper", start=inside_a_block())


def test_a_world_that_brings_its_patterns_is_flown_with_them_under_plaid_which_is_said(tmp_path):
    bricks, none = make_config("medium", surface={"pattern": "bricks"}), Config()
    pool = families.world_of_file(bricks, load_scene(resolve_world("paper")))
    write_scene(take_scene(pool, 0), tmp_path / "bricks.xml")
    said = {}
    for pattern, config in {"plaid": none, "checks": make_config("medium", surface={"pattern": "checks"})}.items():
        course = load_missions(config, str(tmp_path / "bricks.xml"))
        surface = course.scene().boxes.surface
        assert surface is not None
        said[pattern] = surface.patterns, course.note
    assert said["plaid"][0] == ("bricks",) and "has patterns of its own, and no plaid" in said["plaid"][1]
    assert said["checks"] == (("checks",), None)


def test_a_world_without_a_volume_is_flown_in_the_box_that_holds_start_and_goal(tmp_path):
    file = tmp_path / "open.xml"
    file.write_text(
        '<mujoco><worldbody><geom type="plane" size="0 0 1"/><geom type="box" pos="20 0 5" size="2 2 5"/>'
        '<site name="start" pos="0 0 2"/><site name="goal" pos="40 0 2"/></worldbody></mujoco>'
    )
    own = load_missions(CONFIG, str(file))
    assert own.note is None
    course = load_missions(CONFIG, str(file), start=(-30, 0, 2), goal=(40, 3, 12))
    lower, upper = np.asarray(course.scene().volume)
    np.testing.assert_allclose(lower, [-35.0, float(own.scene().volume[0, 1]), 0.0])
    np.testing.assert_allclose(upper, own.scene().volume[1])
    assert course.note is not None and "names no flight volume: it is flown in x, y, z = -35 to 45" in course.note
    with pytest.raises(ConfigError, match="the goal .* is too far from the shapes of '.*open.xml'"):
        load_missions(CONFIG, str(file), goal=(1e6, 0.0, 2.0))
    # A volume that the file names is kept to.
    bounded = file.read_text().replace(
        "</worldbody>", '<site name="volume" type="box" pos="20 0 5" size="25 9 5"/></worldbody>'
    )
    file.write_text(bounded)
    with pytest.raises(ConfigError, match="outside the flight volume"):
        load_missions(CONFIG, str(file), start=(-30, 0, 2))


@pytest.mark.slow
def test_a_run_in_random_worlds_ends_with_the_world_that_is_to_be_flown_and_then_the_test_worlds():
    sizes, count = {"pool_size": 3, "missions": 8}, {"validation_missions": 3}
    here, there = (
        run_missions(make_config("sparse", world={**sizes, "flown": flown}, train=count)) for flown in ("", "paper")
    )
    assert (here.tests, there.tests) == (3, 2)
    city, flown = load_scene(resolve_world("paper")), there.final.env_params
    np.testing.assert_array_equal(flown.missions.start[0], city.start)
    np.testing.assert_array_equal(flown.missions.goal[0], city.goal)
    point = jnp.array([31.0, 33.0, 4.0])
    assert signed_distance(there.scene, point) == pytest.approx(float(signed_distance(city, point)), abs=1e-5)
    # The others are the test worlds, and validation is what it was.
    np.testing.assert_array_equal(flown.missions.start[1:], here.final.env_params.missions.start[:2])
    np.testing.assert_array_equal(flown.pool.spheres.position[1:], here.final.env_params.pool.spheres.position[:2])
    np.testing.assert_array_equal(flown.missions.scene, range(3))
    np.testing.assert_array_equal(there.validation.env_params.missions.start, here.validation.env_params.missions.start)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a.shape, b.shape), there.validation.env_params, flown)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sparse", "paper"])
def test_runs_of_several_seeds_have_the_missions_of_each_alone(name):
    config = make_config(name, world={"pool_size": 3, "missions": 8}, train={"validation_missions": 3})
    configs = [dataclasses.replace(config, train=dataclasses.replace(config.train, seed=seed)) for seed in (0, 5)]
    together = missions_of_runs(configs)
    for own, alone in zip(together, map(run_missions, configs), strict=True):
        for kind in ("training", "validation", "final"):
            jax.tree.map(np.testing.assert_array_equal, getattr(own, kind).env_params, getattr(alone, kind).env_params)
    first, second = (each.training.env_params.missions.start for each in together)
    assert not np.array_equal(first, second)


def test_several_drones_are_not_flown_where_balls_are_thrown():
    trained = make_config("sparse", world={"balls": 1})
    together = dataclasses.replace(trained, env=dataclasses.replace(trained.env, drones=2))
    with pytest.raises(ConfigError, match=r"^with env.drones 2 the world must throw no balls"):
        load_missions(together, "sparse", 4)
