"""Any function of an observation, a memory and a key flies as our policies do, and is told what it does wrong."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import edqn_jax
from edqn_jax.cli import main
from edqn_jax.config import Config
from edqn_jax.config.loading import with_conditions
from edqn_jax.config.registry import ACTION_SETS
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.trajectories import flight_trajectory, trajectory_columns
from edqn_jax.evaluation.verdicts import check_verdicts
from edqn_jax.interop import functional
from edqn_jax.interop.deployment.onnx_export import export_policy
from edqn_jax.learn.actor import AgentActor
from edqn_jax.learn.policy import Policy
from edqn_jax.policies.functions import FunctionActor, FunctionPolicy, actor_of, load_function
from edqn_jax.sim.actions import Discrete
from edqn_jax.sim.task.action_sets import VELOCITY, ActionSet
from edqn_jax.sim.task.env import Observation
from tests.support.miniature import WORLD
from tests.support.policies import CONFIG, fresh
from tests.support.registries import keep_as_they_are

pytestmark = pytest.mark.whole

BLIND = dataclasses.replace(
    CONFIG,
    env=dataclasses.replace(CONFIG.env, sensor="blind", max_decisions=20),
    world=dataclasses.replace(CONFIG.world, name=str(WORLD), flown=""),
)

MISSIONS = 6

AHEAD, HOVER, UP = (int(edqn_jax.move_number(name)) for name in ("ahead", "hover", "up"))

FILE = """
import dataclasses

import beside
import edqn_jax


def climbs(observation, memory, key):
    return beside.UP, memory


@dataclasses.dataclass(frozen=True)
class Climbs:
    move: str = "up"

    def __call__(self, observation, memory, key):
        return self.move, memory


another = Climbs()
config = edqn_jax.make_config(
    "WORLD", env={"sensor": "blind", "max_decisions": 20}, drone={"physics": "rigid_body"}, world={"flown": ""}
)
configured = edqn_jax.FunctionPolicy(another, config)
number = 3
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "beside.py").write_text("UP = (0, 0, 1)\n")
    (tmp_path / "mine.py").write_text(FILE.replace("WORLD", str(WORLD)))
    return tmp_path / "mine.py"


def moves_of(evaluation: edqn_jax.Evaluation) -> np.ndarray:
    record = evaluation.flights.record
    assert record is not None
    return np.asarray(record.action)


def flown(function: Any, memory: Any = None, config: Config = BLIND, **options: Any) -> edqn_jax.Evaluation:
    policy = FunctionPolicy(function, config, memory)
    return edqn_jax.evaluate(policy, missions=MISSIONS, record=True, **options)


def test_a_function_that_acts_as_the_agent_flies_as_the_agent() -> None:
    params, actor = fresh(BLIND, 1), AgentActor(BLIND)
    ours = edqn_jax.evaluate(Policy(BLIND, params), missions=MISSIONS, record=True)

    def act(observation: Observation, memory: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        return actor.act(params, memory, observation, key)

    theirs = flown(act, actor.init)
    assert len(np.unique(moves_of(ours))) > 2
    for mine, other in zip(jax.tree.leaves(ours.flights), jax.tree.leaves(theirs.flights), strict=True):
        np.testing.assert_array_equal(mine, other)
    agreed = check_verdicts(BLIND, theirs.missions, theirs.flights)
    assert len(agreed) == MISSIONS and all(each.agrees for each in agreed)


def test_a_memory_begins_with_the_episode_and_every_drone_has_keys_of_its_own() -> None:
    def act(observation: Observation, memory: dict, key: jax.Array) -> tuple[jax.Array, dict]:
        drawn = jax.random.randint(key, (), 0, 27)
        first = {"decision": memory["decision"] + 1, "drawn": drawn}
        # Ahead first, then what was drawn a decision before.
        return jnp.where(memory["decision"] == 0, AHEAD, memory["drawn"]), first

    def fresh() -> dict:
        return {"decision": 0, "drawn": jnp.int32(HOVER)}

    first, again = flown(act, fresh), flown(act, fresh)
    moves = moves_of(first)
    assert np.all(moves[:, 0] == AHEAD) and len(set(moves[:, 1])) > 1 and len({tuple(row) for row in moves}) == MISSIONS
    np.testing.assert_array_equal(moves, moves_of(again))
    assert set(np.unique(flown(act, fresh, seed=1).flights.decisions)) and not np.array_equal(
        moves, moves_of(flown(act, fresh, seed=1))
    )


def test_a_bare_function_flies_as_the_worlds_default_does(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def missions(config: Config, *_: Any) -> None:
        asked.append(config)
        raise InterruptedError

    monkeypatch.setattr("edqn_jax.evaluation.evaluate.load_missions", missions)
    for world in ("paper", None):
        with pytest.raises(InterruptedError):
            edqn_jax.evaluate(lambda observation, memory, key: ("ahead", memory), world)
    assert asked == [edqn_jax.make_config("paper"), edqn_jax.make_config()]
    assert asked[0].events.threshold != asked[1].events.threshold


@pytest.mark.parametrize(
    ("function", "memory", "says"),
    [
        (lambda o, m, k: 22, None, r"a function \(observation, memory, key\) -> \(action, memory\); this one .* int"),
        (lambda o, m, k: ("ahed", m), None, "did you mean 'ahead'"),
        (lambda o, m, k: (27, m), None, "number from 0 to 26"),
        (lambda o, m, k: (None, m), None, "this one returned None in place of an action"),
        (lambda o, m, k: (o.own, m), None, r"actions are float32\[10\]; a move is a number from 0 to 26"),
        (lambda o, m, k: (22, o.own), None, r"the one that it is given, None, not float32\[10\]"),
        (lambda o, m, k: (22, {"n": m["n"] + 0.5}), lambda: {"n": 0}, r"\{'n': int32\[\]\}, not \{'n': float32\[\]\}"),
    ],
)
def test_what_a_function_does_wrong_is_said(function: Any, memory: Any, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        flown(function, memory)


def test_a_move_that_is_computed_and_does_not_exist_is_recorded_as_it_is_flown() -> None:
    seen = edqn_jax.make("paper").reset(0, 0)[1]
    for number, flies in ((100, 26), (-3, 0)):
        actor = FunctionActor(lambda o, m, k, n=number: (jnp.argmax(o.own) * 0 + n, m))
        assert int(jax.jit(actor.act)(None, None, seen, jax.random.key(0))[0]) == flies


def commanded_by(actions: str) -> Config:
    return dataclasses.replace(BLIND, env=dataclasses.replace(BLIND.env, actions=actions))


def test_a_velocity_flies_as_the_move_of_its_numbers_and_is_recorded_as_it_is_flown() -> None:
    config = commanded_by("velocity")
    fast = flown(lambda o, m, k: (jnp.array([0.0, 0.0, 3.0]) + 0.0 * o.own[0], m), config=config)  # 3 is cut off
    move = flown(lambda o, m, k: ("up", m))
    for one, other in zip(
        jax.tree.leaves(dataclasses.replace(fast.flights, record=None)),
        jax.tree.leaves(dataclasses.replace(move.flights, record=None)),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    there = np.isfinite(moves_of(fast)[..., 0])
    assert np.all(moves_of(fast)[there] == [0.0, 0.0, 1.0]) and np.array_equal(there, moves_of(move) >= 0)
    columns = flight_trajectory(config, fast.flights, 1)
    assert tuple(columns) == trajectory_columns(3) and set(columns["action_2"]) == {1.0}


def test_body_rates_and_an_action_set_of_ones_own_fly(monkeypatch: pytest.MonkeyPatch) -> None:
    config = commanded_by("body-rates")
    rises = flown(lambda o, m, k: (jnp.array([1.0, 0.0, 0.0, 0.0]) + 0.0 * o.own[0], m), config=config)
    z = rises.path(0)[:, 2]
    assert z[-1] > z[0] and moves_of(rises).shape == (MISSIONS, 20, 4)

    def command(config: Config, airframe: Any, state: Any, goal: jax.Array, action: jax.Array) -> Any:
        return VELOCITY.command(config, airframe, state, goal, jnp.array([0.0, 0.0, 1.0]) * action)

    throttle = ActionSet(Discrete(2), np.int32(0), command, lambda state, action: jnp.array([0.0, 0.0, 1.0]) * action)
    keep_as_they_are(monkeypatch)
    ACTION_SETS.register("throttle", throttle)
    # A number beyond those that there are is cut off, and recorded as it is flown.
    climbs = flown(lambda o, m, k: (jnp.argmax(o.own) * 0 + 7, m), config=commanded_by("throttle"))
    assert set(np.unique(moves_of(climbs))) == {-1, 1} and climbs.path(0)[-1, 2] > climbs.path(0)[0, 2]


@pytest.mark.parametrize(
    ("actions", "function", "says"),
    [
        (
            "velocity",
            lambda o, m, k: ("ahead", m),
            "action of 'velocity' is 3 finite numbers from -1 to 1, not 'ahead'",
        ),
        ("velocity", lambda o, m, k: ((0.0, np.inf, 0.0), m), "an action of 'velocity' is 3 finite numbers"),
        ("velocity", lambda o, m, k: (o.own[:4], m), r"3 finite numbers from -1 to 1, not an array of shape \(4,\)"),
        ("moves", lambda o, m, k: ("up" if o.own[0] > 0 else "down", m), r"write jnp.where"),
        ("moves", lambda o, m, k: (int(np.sin(o.own[0])), m), r"\(line \d+ of 'test_functions.py': .*np.sin"),
        ("velocity", lambda o, m, k: ((float(o.own[0]), 0.0, 0.0), m), "known in flight alone"),
    ],
)
def test_what_is_no_action_or_asks_too_soon_is_said(actions: str, function: Any, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        flown(function, config=commanded_by(actions))


@dataclasses.dataclass
class Unhashable:
    def __call__(self, observation: Observation, memory: Any, key: jax.Array) -> tuple[str, Any]:
        return "up", memory


@pytest.mark.parametrize("function", [lambda: 0, lambda observation: 0, lambda o, m, k, more: (0, m)])
def test_a_function_with_other_arguments_is_refused_where_it_is_given(function: Any) -> None:
    with pytest.raises(ConfigError, match=r"^a policy must be a function \(observation, memory, key\), not one of \("):
        edqn_jax.evaluate(function)
    with pytest.raises(ConfigError, match=r"^memory must be a function \(\), not one of \(key\)$"):
        FunctionPolicy(lambda o, m, k: (0, m), memory=lambda key: 0)  # type: ignore[arg-type, misc]


def test_what_a_function_raises_itself_is_not_changed() -> None:
    def fails(observation: Observation, memory: Any, key: jax.Array) -> Any:
        raise KeyError("my own")

    with pytest.raises(KeyError, match="my own"):
        flown(fails)


@pytest.mark.parametrize("thing", [3, Config, "ahead"])
def test_what_is_no_policy_is_refused(thing: Any) -> None:
    with pytest.raises(ConfigError, match="a policy is a function"):
        edqn_jax.evaluate(thing)
    with pytest.raises(ConfigError, match="must be hashable"):
        FunctionPolicy(Unhashable())
    with pytest.raises(ConfigError, match="memory must be a function"):
        FunctionPolicy(lambda o, m, k: (0, m), memory=jnp.zeros(3))  # type: ignore[arg-type]


def test_what_needs_parameters_says_so(tmp_path: Path) -> None:
    function: Any = FunctionPolicy(lambda o, m, k: (0, m))
    with pytest.raises(ConfigError, match="save_policy needs a policy of `train` or `load_policy`, with parameters"):
        edqn_jax.save_policy(function, tmp_path / "saved")
    with pytest.raises(ConfigError, match="an ONNX file needs a policy"):
        export_policy(function, tmp_path / "policy.onnx")
    with pytest.raises(ConfigError, match="observation 'code' needs a policy"):
        functional.make("sparse", observation="code", policy=function)
    assert not list(tmp_path.iterdir())


def test_a_function_is_found_in_a_file_and_in_a_module(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    function = load_function(f"{file}:climbs")
    assert callable(function) and function.__name__ == "climbs"
    assert load_function(f"{file}:configured").config.env.sensor == "blind"  # type: ignore[union-attr]
    monkeypatch.chdir(file.parent)
    assert load_function("mine:another").move == "up"  # type: ignore[union-attr]
    for name, says in (
        (f"{file}:climb", "has no 'climb'; did you mean 'climbs'"),
        (f"{file}:number", "is of the type int; a policy is a function"),
        (f"{file}:Climbs", "is of the type type"),
        ("no_such_module:climbs", "there is no module 'no_such_module'; give a file"),
    ):
        with pytest.raises(ConfigError, match=says):
            load_function(name)
    fails = file.with_name("fails.py")
    fails.write_text("one = 1\nraise RuntimeError('not today')\n")
    with pytest.raises(ConfigError, match="does not load: RuntimeError: not today, line 2"):
        load_function(f"{fails}:climbs")


def test_the_commands_fly_a_function(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures, flights, page = (tmp_path / name for name in ("figures.json", "flights.npz", "page.html"))
    words = ["evaluate", f"{file}:configured", "--missions", "2", "--json", figures, "--trajectories", flights]
    assert main([str(word) for word in words]) == 0
    found = json.loads(figures.read_text())
    assert found["missions"] == 2 and found["successes"] == 0 and found["policy_function"]["name"] == "Climbs"
    assert len(found["policy_function"]["source_sha256"]) == 64 and "policy_sha256" not in found
    actions = np.load(flights)["actions"]
    assert set(np.unique(actions)) == {-1, UP}
    assert main(["report", f"{file}:configured", "--missions", "1", "--out", str(page)]) == 0
    assert "mine.py:configured" in page.read_text() and "flying 1 mission of" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["verify", "pretrained"], "'pretrained' comes with the package, without the run; give the folder of a run"),
        (["check", "rooms", "--seed", "-1"], "--seed must be from 0 to 2147483646, not -1"),
        (["verify", "mine.py:f"], "'edqn verify' needs a saved policy, with its parameters, and 'mine.py:f' is a"),
        (["export", "mine:f", "--out", "a.onnx"], "'edqn export' needs a saved policy"),
        (["evaluate", "nowhere.py:f"], "there is no file 'nowhere.py'"),
        (["record", "nowhere.py:f", "a.gif"], "there is no file 'nowhere.py'"),
    ],
)
def test_a_command_that_cannot_says_so(words: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    assert says in capsys.readouterr().err


@pytest.mark.slow
def test_a_flight_of_a_function_is_recorded_with_what_it_saw(tmp_path: Path) -> None:
    config = dataclasses.replace(BLIND, env=dataclasses.replace(BLIND.env, sensor="events"))
    policy = FunctionPolicy(lambda observation, memory, key: ("up", memory), config)
    done = edqn_jax.record(policy, tmp_path / "up.gif")
    assert done.outcome in ("left_volume", "time_out") and (tmp_path / "up.gif").stat().st_size > 10_000
    edqn_jax.write_report([policy], tmp_path / "up.html", missions=1)
    text = (tmp_path / "up.html").read_text()
    assert '"name":"brightness"' in text and "from the code" not in text and "predicted" not in text
    with pytest.raises(ConfigError, match=r"must end in \.gif or \.mp4"):
        edqn_jax.record(policy, tmp_path / "up.png")
    policy = FunctionPolicy(
        lambda observation, memory, key: ((0.0, 0.0, 1.0), memory),
        dataclasses.replace(config, env=dataclasses.replace(config.env, actions="velocity")),
    )
    assert edqn_jax.record(policy, tmp_path / "fast.gif").outcome == done.outcome
    edqn_jax.record(policy, tmp_path / "fast.npz")
    with np.load(tmp_path / "fast.npz") as held:
        assert np.all(held["flight_action"][1:] == [0.0, 0.0, 1.0]) and not held["flight_action"][0].any()
        np.testing.assert_array_equal(held["flight_move"], held["flight_action"])


@pytest.mark.parametrize("exposure", [{"real": True}, {"longest_s": 0.05}, {"latency_s": 0.05}])
def test_an_encoder_flies_with_as_many_attitudes_as_it_was_trained_with(exposure: dict[str, Any]) -> None:
    sees = {"env": {"sensor": "frame-pair"}, "camera": {"mount": "body"}, "light": {"least_lux": 1, "most_lux": 1}}
    learnt = {"real": "real" not in exposure, "longest_s": 0.02}
    trained = edqn_jax.make_config("medium", exposure=learnt, **sees)
    policy = Policy(trained, params=None)  # type: ignore[arg-type]
    flown = with_conditions(trained, {"exposure": exposure}, "test")
    with pytest.raises(ConfigError, match="values of the own motion and would be given .*'frame-pair' looks, .* body;"):
        actor_of(policy, flown)
    assert isinstance(actor_of(policy, with_conditions(trained, {"air": {"gusts_m_s": 1.0}}, "test")), AgentActor)
    assert isinstance(actor_of(FunctionPolicy(lambda observation, memory, key: (0, memory)), flown), FunctionActor)


def test_the_name_of_a_policy_is_answered_with_how_it_is_loaded() -> None:
    with pytest.raises(ConfigError, match=r"or what edqn_jax.load_policy\('pretrained'\) returns, not its name$"):
        edqn_jax.evaluate("pretrained")  # type: ignore[arg-type]
