"""The public names: loaded lazily, documented on one page, and enough for what people do in a notebook."""

from __future__ import annotations

import ast
import dataclasses
import subprocess
import sys
from functools import partial
from importlib import metadata
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import edqn_jax
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.interop import functional
from edqn_jax.learn.perception import vae
from edqn_jax.report.page import document
from edqn_jax.sim.actions import ACTIONS
from edqn_jax.sim.scene.distance import signed_distance
from edqn_jax.sim.sensors.sensor import DEPTH_SCALE, nearness
from edqn_jax.sim.task.env import nearness as nearness_of
from edqn_jax.training import loop
from tests.support.miniature import WORLD
from tests.support.policies import CONFIG, always

ROOT = Path(__file__).parents[1]

QUICK = dataclasses.replace(
    CONFIG,
    drone=dataclasses.replace(CONFIG.drone, physics="rigid_body"),
    world=dataclasses.replace(CONFIG.world, name=str(WORLD)),
)
"""Compiles in less time, for what depends neither on the physics nor on the world."""


@pytest.mark.parametrize(
    "command", ["import edqn_jax; dir(edqn_jax)", "from edqn_jax.cli import main; main(['--help'])"]
)
def test_neither_importing_nor_help_imports_jax_or_mujoco(command: str) -> None:
    script = f"import sys\n{command}\nsys.exit(bool({{'jax', 'mujoco'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_public_name_can_be_loaded_and_no_other() -> None:
    assert set(edqn_jax.__all__) == {*edqn_jax._MODULES, "__version__"} == set(dir(edqn_jax))
    for name in edqn_jax.__all__:
        assert getattr(edqn_jax, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'trian'"):
        edqn_jax.trian  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]


def test_a_checkout_that_is_not_installed_has_no_version(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.delitem(vars(edqn_jax), "__version__", raising=False)
    with monkeypatch.context() as patched:
        patched.setattr(metadata, "version", missing)
        assert edqn_jax.__version__ == "0+unknown"
    del edqn_jax.__version__
    assert edqn_jax.__version__ == metadata.version("edqn-jax")


def test_the_page_of_the_api_has_every_public_name() -> None:
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    assert [name for name in edqn_jax.__all__ if f"`{name}" not in page] == []


@pytest.mark.parametrize(
    ("move", "number"),
    [("ahead", 22), ((1, 0, 0), 22), (22, 22), ("hover", 13), ("right-down back", 0), (np.array([1, 1, 1]), 26)],
)
def test_a_move_has_a_number_a_vector_and_a_name(move: object, number: int) -> None:
    assert int(edqn_jax.move_number(move)) == number  # type: ignore[arg-type]


def test_names_of_moves_lead_back_to_their_numbers() -> None:
    names = [edqn_jax.move_name(number) for number in range(len(ACTIONS))]
    assert len(set(names)) == len(ACTIONS)
    assert [int(edqn_jax.move_number(name)) for name in names] == list(range(len(ACTIONS)))


@pytest.mark.parametrize(
    ("move", "message"),
    [
        ("ahed", "did you mean 'ahead'"),
        ("ahead back", "same axis twice"),
        (27, "number from 0 to 26"),
        ((2, 0, 0), "vec"),
    ],
)
def test_a_move_that_is_none_is_named(move: object, message: str) -> None:
    with pytest.raises(edqn_jax.ConfigError, match=message):
        edqn_jax.move_number(move)  # type: ignore[arg-type]


def test_without_a_configuration_what_is_trained_is_that_of_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[edqn_jax.Config] = []

    def prepared(config: edqn_jax.Config, *_: object, **__: object) -> None:
        asked.append(config)
        raise InterruptedError

    monkeypatch.setattr(loop, "set_up_training", prepared)
    for train in (edqn_jax.train, lambda: edqn_jax.train_seeds(2)):
        with pytest.raises(InterruptedError):
            train()
    assert asked == [edqn_jax.make_config()] * 2 and asked[0].world.flown == "paper"


def test_options_are_given_by_group_and_the_world_brings_its_own() -> None:
    config = edqn_jax.make_config("medium", train={"num_envs": 64}, agent={"n_step": 5})
    assert (config.world.name, config.train.num_envs, config.agent.n_step) == ("medium", 64, 5)
    assert config.events.threshold == 0.03 != edqn_jax.make_config("paper").events.threshold
    with pytest.raises(edqn_jax.ConfigError, match="agent.n_stp.*did you mean 'n_step'"):
        edqn_jax.make_config(agent={"n_stp": 5})
    with pytest.raises(edqn_jax.ConfigError, match="train.num_envs must be a multiple"):
        edqn_jax.make_config(train={"num_envs": 12})


@pytest.mark.slow
def test_an_environment_is_made_from_a_family_or_a_file(tmp_path: Path) -> None:
    two, other = edqn_jax.make("sparse", CONFIG, worlds=2), edqn_jax.make("sparse", CONFIG, worlds=2, seed=1)
    assert two.missions == 2 and not np.array_equal(two.world.pool.start, other.world.pool.start)
    with pytest.raises(edqn_jax.ConfigError, match="worlds must be 1 for 'paper'"):
        edqn_jax.make("paper", CONFIG, worlds=2)
    file = tmp_path / "open.xml"
    file.write_text(
        '<mujoco><worldbody><geom type="plane" size="0 0 1"/>'
        '<site name="start" pos="2 2 3"/><site name="goal" pos="20 2 3"/></worldbody></mujoco>'
    )
    np.testing.assert_allclose(edqn_jax.make(file, CONFIG).scene().goal, [20, 2, 3])
    file.write_text(two.mjcf(1))
    drawn, written = two.scene(1), edqn_jax.make(file, CONFIG).scene()
    np.testing.assert_allclose(written.start, drawn.start, atol=1e-5)
    low, high = np.asarray(drawn.volume)
    points = np.random.default_rng(0).uniform(low, high, (50, 3)).astype(np.float32)
    for point in points:
        assert signed_distance(written, point) == pytest.approx(float(signed_distance(drawn, point)), abs=2e-5)


@pytest.mark.slow
def test_an_environment_is_reset_stepped_and_seen() -> None:
    environment = edqn_jax.make("paper", CONFIG)
    state, observation = environment.reset()
    np.testing.assert_allclose(state.drone.position, [1, 1, 3])
    assert len(environment.events(observation)) == 0  # at rest nothing changes
    streams, images = [], []
    for _ in range(8):
        state, step = environment.step(state, "ahead")
        streams.append(environment.events(step.observation))
        images.append(environment.event_image(step.observation))
    assert float(state.drone.position[0]) > 2 and float(state.drone.position[1]) > 2  # the goal lies that way
    assert [len(stream) for stream in streams] == [np.abs(image).sum() for image in images]
    assert sum(len(stream) for stream in streams) > 0
    picture = environment.picture(state)
    assert picture.shape == (48, 64, 3) and 0 <= picture.min() < picture.max() <= 1


@pytest.mark.slow
def test_many_drones_are_a_vmap() -> None:
    environment = edqn_jax.make(WORLD, QUICK)
    states, _ = jax.vmap(environment.reset)(jax.random.split(jax.random.key(0), 3))
    vectors = np.array([[1, 0, 0], [0, 0, 1], [0, 0, 0]])
    states, _ = jax.vmap(environment.step)(states, vectors)
    alone, _ = environment.step(environment.reset(jax.random.split(jax.random.key(0), 3)[1])[0], "up")
    np.testing.assert_allclose(states.drone.position[1], alone.drone.position, atol=1e-4)


@pytest.mark.slow
def test_a_policy_acts_is_saved_and_is_evaluated(tmp_path: Path) -> None:
    policy = edqn_jax.Policy(QUICK, always((1, 0, 0)))
    move, memory = policy.act(edqn_jax.make(WORLD, QUICK).reset()[1])
    assert edqn_jax.move_name(move) == "ahead" and memory.shape[0] == QUICK.agent.history
    edqn_jax.save_policy(policy, tmp_path / "policy")
    with pytest.raises(edqn_jax.ConfigError, match="holds files already"):
        edqn_jax.save_policy(policy, tmp_path / "policy")
    flown = edqn_jax.evaluate(edqn_jax.load_policy(tmp_path / "policy"), missions=2, record=True)
    assert flown.success_rate == flown.outcomes.count("goal") / 2
    path = flown.path(1)
    assert path.shape == (int(flown.flights.physics_steps[1]), 3) and np.isfinite(path).all()


@pytest.mark.slow
def test_a_policy_shows_its_code_and_the_distances_that_its_decoder_draws() -> None:
    policy, environment = edqn_jax.Policy(QUICK, always((1, 0, 0))), edqn_jax.make(WORLD, QUICK)
    _, observation = environment.reset()
    code = policy.code(observation)
    _, memory = policy.act(observation)
    np.testing.assert_allclose(code * QUICK.agent.code_scale, memory[-1, : QUICK.encoder.code_size], rtol=1e-6)
    drawn = np.asarray(policy.depth(code))
    drawing = vae.decode(QUICK.encoder, QUICK.camera, policy.params.encoder, code)[0] / DEPTH_SCALE
    assert drawn.shape == (QUICK.camera.height, QUICK.camera.width)
    shown = (drawing > 0) & (drawing < 1)
    np.testing.assert_allclose(nearness(jnp.asarray(drawn))[shown], drawing[shown], rtol=1e-4)
    assert np.all(np.isinf(drawn[np.asarray(drawing) <= 0])) and np.all(drawn >= 0)
    sensed = dataclasses.replace(QUICK, encoder=dataclasses.replace(QUICK.encoder, target="sensed"))
    with pytest.raises(edqn_jax.ConfigError, match="encoder.target must be 'nearness' or 'both'"):
        edqn_jax.Policy(sensed, policy.params).depth(code)
    blind = dataclasses.replace(QUICK, env=dataclasses.replace(QUICK.env, sensor="blind"))
    with pytest.raises(edqn_jax.ConfigError, match="the policy's sensor 'blind' has no encoder"):
        edqn_jax.Policy(blind, policy.params).code(observation)


def test_the_true_depth_is_what_the_depth_sensor_shows() -> None:
    environment = edqn_jax.make(WORLD, QUICK)
    state, _ = environment.reset()
    depth = environment.depth(state)
    label = nearness_of(QUICK, environment.world, state)
    np.testing.assert_allclose(DEPTH_SCALE * np.asarray(nearness(jnp.asarray(depth))), label, atol=1e-5)
    assert np.isinf(depth[0]).any() and 0 < depth.min() < 20  # the sky, and what stands ahead


def test_pictures_and_depth_are_drawn_within_programs_of_ones_own() -> None:
    environment = edqn_jax.make(WORLD, QUICK)
    states, _ = jax.vmap(environment.reset)(jax.random.split(jax.random.key(0), 2))
    first = jax.tree.map(lambda x: x[0], states)
    for see in (environment.depth, partial(environment.picture, scale=1)):
        alone, many = jax.jit(see)(first), jax.jit(jax.vmap(see))(states)
        np.testing.assert_allclose(alone, see(first), rtol=1e-5)
        np.testing.assert_allclose(many[0], alone, rtol=1e-5)
        assert many.shape == (2, *alone.shape)


def test_the_worlds_of_a_split_are_those_of_its_missions() -> None:
    test, training = (edqn_jax.make("sparse", QUICK, worlds=3, split=split) for split in ("test", "training"))
    evaluated = load_missions(QUICK, "sparse", 3, 0).env_params.pool
    np.testing.assert_array_equal(test.world.pool.start, evaluated.start)
    np.testing.assert_array_equal(test.world.pool.goal, evaluated.goal)
    assert np.any(test.world.pool.start != training.world.pool.start)
    with pytest.raises(edqn_jax.ConfigError, match="split must be one of training, validation, test, not 'tset'"):
        edqn_jax.make("sparse", QUICK, split="tset")  # type: ignore[arg-type]


def test_a_path_is_planned_and_drawn_on_the_map() -> None:
    scene = edqn_jax.make(WORLD, QUICK).scene()
    planned = edqn_jax.plan(scene)
    assert planned.path is not None
    np.testing.assert_allclose(planned.path[[0, -1]], [scene.start, scene.goal], atol=1e-5)
    assert min(float(signed_distance(scene, point)) for point in jnp.asarray(planned.path, jnp.float32)) > 0.35
    assert planned.found and planned.length_m >= float(jnp.linalg.norm(scene.goal - scene.start)) - 1e-5
    unfit = edqn_jax.plan(scene, body_radius=50.0)
    assert not unfit.found and unfit.reason.startswith("no path: a sphere of 50 m does not fit at the start")
    axes = Figure().add_subplot()
    edqn_jax.draw_map(axes, scene)
    (low, *_), (high, *_) = np.asarray(scene.volume)
    assert axes.get_xlim()[0] <= low < high <= axes.get_xlim()[1] and len(axes.patches) + len(axes.collections) > 3


UNIX = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "termios", "tty"}
"""Modules that no other system has."""


def test_no_module_imports_what_only_unix_has() -> None:
    files = sorted((ROOT / "edqn_jax").rglob("*.py"))
    imported = {
        (file.name, name.split(".")[0])
        for file in files
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module or ""] if isinstance(node, ast.ImportFrom) else [each.name for each in node.names])
    }
    assert len(files) > 100 and not {(file, name) for file, name in imported if name in UNIX}


@pytest.mark.parametrize("config", [{"train": {"seed": 1}}, {}, "medium", edqn_jax.Config])
def test_what_is_no_configuration_is_refused_where_it_is_given(config) -> None:
    for give in (
        lambda: edqn_jax.make("paper", config),
        lambda: edqn_jax.train(config),
        lambda: edqn_jax.train_seeds(2, config),
        lambda: edqn_jax.FunctionPolicy(lambda observation, memory, key: (0, memory), config),
        lambda: functional.make("paper", config),
    ):
        with pytest.raises(edqn_jax.ConfigError, match=r"^config must be an edqn_jax.Config, such as edqn_jax.make_c"):
            give()
    if not isinstance(config, str):
        with pytest.raises(
            edqn_jax.ConfigError, match="^make_config: the first argument must be the name of a world, n"
        ):
            edqn_jax.make_config(config)
        if not isinstance(config, dict):
            with pytest.raises(edqn_jax.ConfigError, match="^evaluate: conditions must be options by group"):
                edqn_jax.evaluate(lambda observation, memory, key: (0, memory), conditions=config)


def test_a_page_is_of_one_policy_or_of_a_list(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked = []
    monkeypatch.setattr(document, "build_report", lambda shown, most: asked.append(shown) or "page")
    policy = edqn_jax.FunctionPolicy(lambda observation, memory, key: (0, memory))
    for shown in (policy, policy.function, "pretrained", tmp_path):
        edqn_jax.write_report(shown, tmp_path / "page.html")
        edqn_jax.write_report([shown], tmp_path / "page.html")
        edqn_jax.write_report((shown, policy), tmp_path / "page.html")
        assert asked[-3:] == [[shown], [shown], [shown, policy]]
    with pytest.raises(edqn_jax.ConfigError, match="a report needs a policy"):
        edqn_jax.write_report([], tmp_path / "page.html")


@pytest.mark.parametrize("shown", [None, 3])
def test_a_page_of_what_is_no_policy_is_refused(shown, tmp_path: Path) -> None:
    with pytest.raises(edqn_jax.ConfigError, match=r"a policy is a function \(observation, memory, key\)"):
        edqn_jax.write_report(shown, tmp_path / "page.html")
