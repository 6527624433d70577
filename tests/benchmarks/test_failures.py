"""Looking back from a collision: what was hit, where it stood, and whether it could be seen."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import failures
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.evaluation.rollouts import fly_on_all_devices
from edqn_jax.sim.camera import camera
from edqn_jax.sim.task.outcomes import Outcome
from tests.support.policies import CONFIG, always

WORLD = """<mujoco><worldbody>
  <geom type="plane" size="0 0 1"/>
  <geom type="box" name="wall" pos="20 0 5" size="1 8 5"/>
  <geom type="sphere" name="far" pos="60 30 3" size="2"/>
  <site name="start" pos="0 0 4"/><site name="goal" pos="40 0 4"/>
  <site name="volume" type="box" pos="30 0 10" size="40 40 10"/>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def course(tmp_path_factory: pytest.TempPathFactory):
    file = tmp_path_factory.mktemp("worlds") / "wall.xml"
    file.write_text(WORLD)
    return load_missions(CONFIG, str(file))


def flown(course, move: tuple[int, int, int]) -> dict:
    flights = fly_on_all_devices(CONFIG, course.env_params, always(move), record=True)
    flights = jax.tree.map(np.asarray, flights)
    assert flights.outcome[0] == Outcome.COLLISION
    return failures.look_back(CONFIG, course, flights, 0)


@pytest.mark.slow
def test_a_wall_straight_ahead_was_in_view_all_the_way(course) -> None:
    row = flown(course, (1, 0, 0))
    assert (row["hit"], row["side"]) == ("block", "ahead")
    assert row["in_view_at_last"] and row["share_in_view_lately"] == 1.0
    assert row["pixels_at_last"] == CONFIG.camera.width * CONFIG.camera.height  # less than a decision away
    assert row["speed_m_s"] == pytest.approx(4.0, abs=0.2)
    # 18.6 m at 4 m/s, and the start from rest; the last move was chosen one decision before.
    assert row["first_seen_s"] == pytest.approx(5.0, abs=0.6)
    assert row["events_lately"] > 0


@pytest.mark.slow
def test_the_ground_is_below(course) -> None:
    row = flown(course, (0, 0, -1))
    assert (row["hit"], row["side"]) == ("ground", "below")


@pytest.mark.slow
def test_a_ball_that_was_thrown_at_a_hovering_drone_is_what_was_hit(tmp_path: Path) -> None:
    file = tmp_path / "ball.xml"
    ball = '<body name="ball" mocap="true" pos="20 0 8"><geom type="sphere" size="0.4"/></body>'
    words = '<custom><text name="motion:ball" data="throw 0.4 2 6 0 0 0 4"/></custom>'
    file.write_text(WORLD.replace("<worldbody>", f"{words}<worldbody>{ball}"))
    row = flown(load_missions(CONFIG, str(file)), (0, 0, 0))
    # Thrown at a drone of steady pace it would be 16 m away, and the ground be nearest.
    assert (row["hit"], row["side"]) == ("ball", "ahead")


@pytest.mark.slow
def test_a_shape_alone_is_all_that_is_left(course) -> None:
    scene = course.scene()
    only = failures.alone(scene, "spheres", 0)
    at, level = jnp.array([50.0, 30.0, 3.0]), jnp.eye(3)
    image = np.asarray(camera.render_depth(CONFIG.camera, only, at, level))
    assert np.isfinite(image).any() and np.isinf(image).any()
    # The rays beside the middle, atan(1 / 8) off along both axes, meet the ball 1.741 m beside its centre.
    assert image.min() == pytest.approx(9.847 - np.sqrt(2.0**2 - 1.741**2), abs=2e-3)
    assert np.isinf(np.asarray(camera.render_depth(CONFIG.camera, failures.alone(scene, "boxes", 0), at, level))).all()


def test_the_table_counts_what_rows_have_in_common() -> None:
    one = {
        "mission": 0,
        "hit": "block",
        "side": "ahead",
        "first_seen_s": 2.0,
        "in_view_at_last": True,
        "share_in_view_lately": 1.0,
        "pixels_at_last": 9,
        "events_lately": 4,
        "speed_m_s": 4.0,
    }
    other = {**one, "side": "below", "in_view_at_last": False, "events_lately": 0, "first_seen_s": None}
    shown = failures.table([one, one, other])
    assert "| what was hit | block 3 |" in shown and "| on which side | ahead 2, below 1 |" in shown
    assert "| out of view when the last move was chosen | 1 |" in shown
    assert (
        "| without any event in these windows | 1 |" in shown
        and "| never in view in the last 40 decisions | 1 |" in shown
    )
    assert "median (quartiles) | 2 (2 to 2) |" in shown  # of those that were seen


def test_a_run_that_is_none_is_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert failures.main([str(tmp_path)]) == 2
    assert "there is no run in" in capsys.readouterr().err
