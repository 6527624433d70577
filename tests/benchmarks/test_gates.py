"""Flying without a policy: what hovering and flying straight come to."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import gates
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.keys import run_streams
from edqn_jax.sim.actions import move_name
from edqn_jax.sim.physics.drone import hover_state
from edqn_jax.sim.task.outcomes import Outcome
from measurement.flags import parse_config, parse_options
from tests.support.policies import CONFIG

WORLD = """<mujoco><worldbody>
  <geom type="plane" size="0 0 1"/>
  {}
  <site name="start" pos="0 0 4"/><site name="goal" pos="20 0 6"/>
  <site name="volume" type="box" pos="30 0 10" size="40 40 10"/>
</worldbody></mujoco>"""


def outcome(folder: Path, inside: str, gate: str) -> Outcome:
    file = folder / "world.xml"
    file.write_text(WORLD.format(inside))
    world = load_missions(CONFIG, str(file)).env_params
    return Outcome(int(gates.outcomes(CONFIG, world, gate, run_streams(0).flights)[0]))


@pytest.mark.parametrize(
    ("way", "yaw", "move"),
    [
        ((10.0, 0.0, 1.0), 0.0, "ahead"),
        ((10.0, 0.0, 9.0), 0.0, "ahead up"),
        ((10.0, 0.0, 0.0), np.pi / 2, "right"),
        ((-5.0, 5.0, -5.0), 0.0, "back left down"),
        ((0.0, 0.0, -3.0), 1.0, "down"),
    ],
)
def test_straight_is_the_move_nearest_to_the_goals_direction(way: tuple[float, ...], yaw: float, move: str) -> None:
    body = hover_state(jnp.array([1.0, 2.0, 30.0]), jnp.float32(yaw))
    assert move_name(gates.straight(body, body.position + jnp.array(way))) == move


def test_who_flies_straight_reaches_a_free_goal_and_hits_a_wall_before_it(tmp_path: Path) -> None:
    assert outcome(tmp_path, "", "straight") == Outcome.GOAL
    wall = '<geom type="box" pos="10 0 5" size="1 8 5"/>'
    assert outcome(tmp_path, wall, "straight") == Outcome.COLLISION


def test_who_hovers_stays_until_time_is_out(tmp_path: Path) -> None:
    assert outcome(tmp_path, "", "hover") == Outcome.TIME_OUT


def test_several_drones_that_fly_straight_hit_each_other() -> None:
    together = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, drones=4, max_decisions=200))
    world = load_missions(together, "sparse", 8).env_params
    found = gates.outcomes(together, world, "straight", run_streams(0).flights)
    alone = gates.outcomes(CONFIG, world, "straight", run_streams(0).flights)
    assert np.sum(found == Outcome.COLLISION) > np.sum(alone == Outcome.COLLISION)


def test_a_world_of_a_file_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        gates.main(["--world", "paper"])
    assert "invalid choice: 'paper'" in capsys.readouterr().err


def test_benchmarks_stay_in_worlds_of_one_plaid_unless_their_options_say_otherwise():
    assert parse_options(["--world", "rooms"]).surface.pattern == "plaid"
    assert parse_config(["--world", "medium"]).surface.pattern == "plaid"
    for words in (["--surface.pattern", "drawn"], ["--surface.pattern=bricks"]):
        assert parse_options(["--world", "rooms", *words]).surface.pattern in ("drawn", "bricks")
