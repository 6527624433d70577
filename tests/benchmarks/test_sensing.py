"""The benchmark of what a look costs: events that are counted one flight after the other, and what it says."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import sensing
from edqn_jax.config.loading import make_config
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.sim.environment import Environment
from edqn_jax.sim.sensors.event_field import EventField
from tests.support.benchmarks.kept_cores import give_cores


@pytest.fixture(scope="module")
def policy() -> Policy:
    """Untrained, in small networks, with short flights."""
    config = make_config("medium", env={"max_decisions": 30}, encoder={"code_size": 4}, drone={"physics": "rigid_body"})
    return Policy(config, fresh_policy(config))


def test_events_are_those_of_flights_one_by_one(policy: Policy) -> None:
    course = load_missions(policy.config, "medium", 3)
    counted = sensing.events_per_decision(policy, course)
    events, decisions = 0, 0
    environment = Environment(policy.config, course.env_params)
    for mission in range(3):
        state, seen = environment.reset(0, mission)
        memory = None
        for _ in range(policy.config.env.max_decisions):
            move, memory = policy.act(seen, memory)
            state, step = environment.step(state, move)
            field = step.observation.sensed
            assert isinstance(field, EventField)
            events, decisions = events + int(np.sum(field.count)), decisions + 1
            if step.outcome != 0:
                break
            seen = step.observation
    assert 30 < decisions < 3 * 30 and events > 100  # flights of several lengths
    np.testing.assert_allclose(counted, events / decisions, rtol=1e-3)  # other programs: an event more or less


def test_it_says_what_each_sensor_costs(
    policy: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    give_cores(monkeypatch, 0)
    monkeypatch.setattr(sensing, "load_policy", lambda name: policy)
    monkeypatch.setattr(sensing, "events_per_decision", lambda *_: 250.0)
    monkeypatch.setattr(sensing, "look_call", lambda config, *_: ("look", config.env.sensor))
    monkeypatch.setattr(sensing, "decision_call", lambda config, *_: ("act", config.env.sensor))
    taken = {"events": [0.002, 0.003, 0.004], "frames": [0.001, 0.002, 0.003], "frame-pair": [0.003, 0.004, 0.005]}

    def in_turn(works: list[tuple[str, str]], *_: int) -> np.ndarray:
        return np.array([taken[sensor] if kind == "look" else [0.001] * 3 for kind, sensor in works])

    monkeypatch.setattr(sensing, "time_interleaved", in_turn)
    file = tmp_path / "sensing.json"
    assert sensing.main(["--worlds", "medium", "--missions", "1", "--json", str(file)]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert [row["bytes_per_decision"] for row in rows] == [1000.0, 768, 1536]
    assert "| medium | events | 250 | 1,000 | 3.00 (3.98) | 1.50 (1.50 to 1.50) | 1.00 |" in capsys.readouterr().out


def test_works_are_timed_in_turns() -> None:
    order: list[str] = []
    taken = sensing.time_interleaved([lambda: order.append("a"), lambda: order.append("b")], 5, block=2)
    assert "".join(order) == "ab" + "aabb" + "aabb" + "ab"  # one of each that compiles, then blocks
    assert taken.shape == (2, 5) and np.all(taken >= 0.0)


def test_ratios_are_those_of_turns() -> None:
    machine = np.repeat([1.0, 5.0, 1.0], sensing.BLOCK)  # slow for one turn: both are
    assert sensing.ratio_of(1.5 * machine, machine) == pytest.approx((1.5, 1.5, 1.5))


@pytest.mark.slow
@pytest.mark.parametrize("sensor", sensing.SENSORS)
def test_the_time_from_photons_to_move_is_that_of_pictures_and_networks(
    policy: Policy, sensor: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn, sense = [], sensing.sense
    monkeypatch.setattr(
        sensing, "sense", lambda config, *given: drawn.append(config.env.sensor) or sense(config, *given)
    )
    config = dataclasses.replace(policy.config, env=dataclasses.replace(policy.config.env, sensor=sensor))
    course = load_missions(policy.config, "medium", 1)
    look = sensing.look_call(config, fresh_policy(config), course.scene())
    taken = sensing.time_interleaved([look], 3)
    assert taken.shape == (1, 3) and np.all(taken > 0.0) and drawn == [sensor]


def test_a_policy_without_events_is_refused(
    policy: Policy, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    blind = dataclasses.replace(policy.config, env=dataclasses.replace(policy.config.env, sensor="blind"))
    give_cores(monkeypatch, 0)
    monkeypatch.setattr(sensing, "load_policy", lambda name: Policy(blind, policy.params))
    assert sensing.main([]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "sees blind" in said
