"""Figures of flights, and `edqn evaluate` from a folder to its files."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import mujoco
import numpy as np
import pytest

from edqn_jax.cli import evaluate as cli_evaluate
from edqn_jax.cli.evaluate import EvaluateArgs, evaluate_command
from edqn_jax.config import Config
from edqn_jax.config.loading import apply_layer, to_yaml
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation import evaluate as evaluation
from edqn_jax.evaluation import latency
from edqn_jax.evaluation.judge import load_judge, replay_contact
from edqn_jax.evaluation.latency import decision_latency_ms
from edqn_jax.evaluation.metrics import shortest_paths, spl, summarise_flights, wilson_interval
from edqn_jax.evaluation.missions import MissionSet, load_missions
from edqn_jax.evaluation.rollouts import ShowPhase
from edqn_jax.learn.actor import AgentActor
from edqn_jax.learn.policy import fresh_policy
from edqn_jax.runs.checkpoints.params import save_params
from edqn_jax.runs.policies import load_policy, load_run
from edqn_jax.sim.task.flights import Closest, Flights
from edqn_jax.sim.task.outcomes import Outcome
from tests.support.policies import CONFIG, always

pytestmark = pytest.mark.whole


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    (folder / "config.yaml").write_text(to_yaml(CONFIG))
    save_params(folder / "checkpoints", always((1, 0, 0)))
    return folder


@pytest.mark.parametrize(
    ("successes", "missions", "low", "high"),
    [  # by bisection of the score equation n (k/n - p)^2 = z^2 p (1 - p), in decimals
        (0, 10, 0.0, 0.277533),
        (5, 10, 0.236593, 0.763407),
        (10, 10, 0.722467, 1.0),
        (70, 100, 0.604151, 0.781051),
        (0, 0, 0.0, 1.0),
    ],
)
def test_the_interval_is_wilsons(successes, missions, low, high):
    assert wilson_interval(successes, missions) == pytest.approx((low, high), abs=2e-6)


def test_spl_is_one_for_the_shortest_path_half_for_twice_it_and_zero_for_a_failure():
    success = np.array([True, True, False, True])
    flown, shortest = np.array([10.0, 20.0, 5.0, 9.0]), np.array([10.0, 10.0, np.nan, 10.0])
    # The last is cut short by the goal's radius and counts as 1, not more.
    assert spl(success, flown, shortest) == pytest.approx((1 + 0.5 + 0 + 1) / 4)


def four_flights() -> Flights:
    outcome = np.array([Outcome.GOAL, Outcome.GOAL, Outcome.COLLISION, Outcome.TIME_OUT])
    return Flights(
        outcome=outcome,  # type: ignore[arg-type]
        decisions=np.array([10, 20, 5, 200]),  # type: ignore[arg-type]
        physics_steps=np.array([125, 260, 60, 2600]),  # type: ignore[arg-type]
        contact=np.array([1.0, 1.0, 0.5, 1.0]),  # type: ignore[arg-type]
        episode_return=np.array([100.0, 90.0, -100.0, 0.0]),  # type: ignore[arg-type]
        path_length_m=np.array([10.0, 30.0, 5.0, 50.0]),  # type: ignore[arg-type]
        flight_seconds=np.array([2.5, 5.2, 1.2, 52.0]),  # type: ignore[arg-type]
        closest=Closest(
            distance=np.array([0.5, 0.2, 0.0, 0.1]),  # type: ignore[arg-type]
            time=np.zeros(4),  # type: ignore[arg-type]
            position=np.zeros((4, 3)),  # type: ignore[arg-type]
            quaternion=np.zeros((4, 4)),  # type: ignore[arg-type]
        ),
        record=None,
    )


def test_figures_of_four_flights_are_those_worked_out_by_hand():
    figures = summarise_flights(four_flights(), np.array([10.0, 20.0, np.nan, np.nan]))
    assert (figures["missions"], figures["successes"], figures["success_rate"]) == (4, 2, 0.5)
    kinds = ("collisions", "left_volume", "timeouts", "diverged")
    assert [figures[kind] for kind in kinds] == [1, 0, 1, 0]
    assert figures["interval"] == pytest.approx([0.150039, 0.849961], abs=2e-6)
    assert figures["spl"] == pytest.approx((1 + 2 / 3) / 4)
    assert figures["path_over_shortest"] == pytest.approx(1.25)
    assert (figures["decisions"], figures["path_length_m"]) == (15.0, 20.0)
    assert figures["flight_seconds"] == pytest.approx(3.85)
    assert figures["return"] == pytest.approx(22.5)
    assert figures["min_clearance_m"] == pytest.approx(0.2)


def test_without_shortest_paths_there_is_no_spl():
    assert summarise_flights(four_flights())["spl"] is None


@pytest.mark.slow
def test_a_decision_takes_a_measured_time():
    latency = decision_latency_ms(CONFIG, always((0, 0, 0)), calls=20)
    assert 0 < latency["median"] <= latency["p99"]


def test_a_run_is_its_configuration_and_its_policy(run):
    config, params = load_run(run)
    assert config == CONFIG
    np.testing.assert_array_equal(params.q["Dense_1"]["bias"], always((1, 0, 0)).q["Dense_1"]["bias"])


def test_no_run_an_empty_one_and_one_that_does_not_fit_are_sentences(tmp_path, run):
    with pytest.raises(ConfigError, match="there is no run in"):
        load_run(tmp_path)
    (tmp_path / "config.yaml").write_text(to_yaml(Config()))
    with pytest.raises(ConfigError, match="config.yaml' is a file; give the folder of a run"):
        load_run(tmp_path / "config.yaml")
    with pytest.raises(ConfigError, match="there is no policy"):
        load_run(tmp_path)
    (tmp_path / "checkpoints").symlink_to(run / "checkpoints")
    with pytest.raises(ConfigError, match="does not have the shapes that its config.yaml asks for"):
        load_run(tmp_path)


def test_a_policy_of_another_version_that_does_not_fit_names_both(tmp_path, run):
    (tmp_path / "checkpoints").symlink_to(run / "checkpoints")
    (tmp_path / "config.yaml").write_text("# edqn_jax 9.8.7\nencoder: {waves: 3}\n")
    with pytest.raises(
        ConfigError, match=f"saved by edqn_jax 9.8.7 and does not fit edqn_jax {version('edqn-jax')}: .*waves"
    ):
        load_run(tmp_path)
    (tmp_path / "config.yaml").write_text("# edqn_jax 9.8.7\n" + to_yaml(Config()))
    with pytest.raises(ConfigError, match="saved by edqn_jax 9.8.7 .* does not have the shapes"):
        load_run(tmp_path)


def test_a_file_that_cannot_be_written_is_named_before_anything_is_flown(run, tmp_path):
    with pytest.raises(ConfigError, match="there is no folder"):
        evaluate_command(EvaluateArgs(run, json=tmp_path / "nowhere" / "figures.json"))


def test_one_file_is_not_asked_for_twice(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="--json and --trajectories are both 'flights'; give two files"):
        evaluate_command(EvaluateArgs(run, json=Path("flights"), trajectories=tmp_path / "flights"))
    assert list(tmp_path.iterdir()) == []


def test_codes_are_shuffled_between_enough_missions(run):
    with pytest.raises(ConfigError, match="--shuffle-codes needs --missions of at least 4, not 1"):
        evaluate_command(EvaluateArgs(run, shuffle_codes=True))


def test_a_policy_that_sees_nothing_has_nothing_to_shuffle(tmp_path):
    blind = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, sensor="blind"))
    (tmp_path / "config.yaml").write_text(to_yaml(blind))
    save_params(tmp_path / "checkpoints", fresh_policy(blind))
    with pytest.raises(ConfigError, match="--shuffle-codes has nothing to shuffle: the sensor 'blind' shows nothing"):
        evaluate_command(EvaluateArgs(tmp_path, missions=4, shuffle_codes=True))


def stand_in_for_flights(monkeypatch: pytest.MonkeyPatch, fly: Callable[..., Flights]) -> None:
    """Replaces what would compile, flights by `fly`."""
    monkeypatch.setattr(evaluation, "load_missions", lambda *_: MissionSet("paper", None, None))  # type: ignore[arg-type]
    monkeypatch.setattr(evaluation, "fly_on_all_devices", fly)
    monkeypatch.setattr(evaluation, "shortest_paths", lambda *_: np.full(4, 10.0))
    monkeypatch.setattr(latency, "decision_latency_ms", lambda *_, **__: {"median": 1.0, "p99": 2.0})


@pytest.mark.parametrize("shuffle_codes", [True, False])
def test_the_command_shuffles_codes_only_when_asked_and_says_so(shuffle_codes, run, tmp_path, monkeypatch, capsys):
    asked = []

    def fly(*_: object, phase: object, **options: object) -> Flights:
        asked.append(options)
        return four_flights()

    stand_in_for_flights(monkeypatch, fly)
    evaluate_command(EvaluateArgs(run, missions=4, shuffle_codes=shuffle_codes, json=tmp_path / "figures.json"))
    flags = {"record": False, "shuffle_codes": shuffle_codes, "decoder_errors": False}
    assert asked == [{"actor": AgentActor(CONFIG), **flags}]
    assert json.loads((tmp_path / "figures.json").read_text())["shuffled_codes"] is shuffle_codes
    assert ("shuffled codes" in capsys.readouterr().out) is shuffle_codes


def test_the_command_flies_under_the_conditions_that_it_is_given_and_says_so(run, tmp_path, monkeypatch, capsys):
    flown, said_before = [], []

    def fly(config: Config, *_: object, **__: object) -> Flights:
        flown.append(config)
        said_before.append(" ".join(capsys.readouterr().out.split()))
        return four_flights()

    stand_in_for_flights(monkeypatch, fly)
    conditions = {"air": {"gusts_m_s": 5.0}, "env": {"action_delay": 1}}
    evaluate_command(EvaluateArgs(run, missions=4, conditions=conditions, json=tmp_path / "figures.json"))
    assert flown == [apply_layer(CONFIG, conditions, "test")] != [CONFIG]
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["conditions"] == {"air.gusts_m_s": 5.0, "env.action_delay": 1}
    said = capsys.readouterr().out
    assert re.search(r"air.gusts_m_s +│ +5.0 ", said) and re.search(r"env.action_delay +│ +1 ", said)
    assert "was trained with" not in said + said_before[0]
    evaluate_command(EvaluateArgs(run, missions=4, conditions={"surface": {"pattern": "bricks"}}))
    assert "trained with surface.pattern plaid alone; with bricks it sees" in said_before[1]
    assert "was trained with" not in capsys.readouterr().out
    with pytest.raises(ConfigError, match="body.mass_share must be at least 0 and less than 1, not 2.0"):
        evaluate_command(EvaluateArgs(run, conditions={"body": {"mass_share": 2.0}}))
    with pytest.raises(
        ConfigError, match="'agent.history' is a policy's own; conditions are camera, env, events, air, body"
    ):
        evaluate_command(EvaluateArgs(run, conditions={"agent": {"history": 3}}))


def test_the_phases_of_an_evaluation_are_shown(run, monkeypatch, capsys):
    def fly(*_: object, phase: ShowPhase | None, **__: object) -> Flights:
        if phase is not None:  # else nobody is told, and all is flown at once
            phase("flying the missions", 1, 4)
        return four_flights()

    stand_in_for_flights(monkeypatch, fly)
    shown: list[tuple[object, ...]] = []
    monkeypatch.setattr(cli_evaluate, "show_phase", lambda *words: shown.append(words))
    evaluate_command(EvaluateArgs(run, missions=4))
    assert shown == [
        ("loading the policy",),
        ("preparing worlds",),
        ("flying the missions", 1, 4),
        ("shortest paths",),
        ("measuring the latency",),
    ]
    said = capsys.readouterr()
    assert "reached the goal" in said.out and said.err == ""
    evaluation.evaluate(load_policy(run), missions=4)
    assert capsys.readouterr() == ("", "")


def test_only_wanted_missions_have_shortest_paths():
    missions = load_missions(CONFIG, "paper", 3)
    lengths = shortest_paths(CONFIG, missions.env_params, np.array([False, True, False]))
    apart = np.linalg.norm(missions.env_params.missions.goal - missions.env_params.missions.start, axis=1)
    assert np.isnan(lengths[[0, 2]]).all()
    assert apart[1] * (1 - 1e-6) <= lengths[1] <= 1.4 * apart[1]


@pytest.mark.slow
def test_a_world_without_a_way_is_a_sentence(run, tmp_path):
    walls = {"9 5 2": ".1 4 2", "1 5 2": ".1 4 2", "5 1 2": "4 .1 2", "5 9 2": "4 .1 2", "5 5 4": "4.2 4.2 .1"}
    geoms = "".join(f'<geom type="box" pos="{pos}" size="{size}"/>' for pos, size in walls.items())
    sites = '<geom type="plane" size="0 0 1"/><site name="start" pos="5 5 2"/><site name="goal" pos="20 20 2"/>'
    (tmp_path / "closed.xml").write_text(f"<mujoco><worldbody>{geoms}{sites}</worldbody></mujoco>")
    with pytest.raises(ConfigError, match="there is no path"):
        evaluate_command(EvaluateArgs(run, world=str(tmp_path / "closed.xml")))


@pytest.mark.slow
def test_the_command_prints_and_writes_flights_that_anybody_can_check(run, tmp_path, capsys):
    figures_file, flights_file = tmp_path / "figures.json", tmp_path / "flights.npz"
    args = EvaluateArgs(run, missions=80, seed=3, json=figures_file, trajectories=flights_file)
    evaluate_command(args)
    assert "reached the goal" in capsys.readouterr().out
    figures = json.loads(figures_file.read_text())
    asked = {"missions", "successes", "success_rate", "interval", "collisions", "left_volume", "timeouts"}
    assert asked | {"diverged", "spl", "world", "seed", "decision_latency_ms"} <= set(figures)
    assert (figures["missions"], figures["world"], figures["seed"]) == (80, "paper", 3)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["figures.json", "flights.npz"]

    flights = np.load(flights_file)
    radius = float(flights["body_radius_m"])
    judges = [load_judge(mujoco.MjSpec.from_string(str(text)), radius) for text in flights["mjcf"]]
    hits = 0
    for i, outcome in enumerate(flights["outcome"]):
        path = flights["positions"][i, : flights["lengths"][i]]
        attitudes = flights["attitudes"][i, : len(path)]
        np.testing.assert_array_equal(path[0], flights["start"][i])
        np.testing.assert_allclose(np.linalg.norm(attitudes, axis=1), 1.0, atol=1e-4)
        contact = replay_contact(judges[flights["scene"][i]], path)
        assert (contact is not None) == (outcome == "collision")
        if contact is not None:
            hits += 1
            assert contact.segment == len(path) - 2
            # A millimetre of a segment of 8 cm.
            assert contact.fraction == pytest.approx(flights["contact"][i], abs=0.0125)
            np.testing.assert_allclose(contact.position, flights["closest_position"][i], atol=1e-3)
    assert hits == figures["collisions"] > 0
