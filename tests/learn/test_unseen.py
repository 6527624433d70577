"""What a policy was not trained with is one sentence each."""

from __future__ import annotations

from pathlib import Path

import pytest

from edqn_jax.config.loading import make_config
from edqn_jax.policies.unseen import describe_unseen
from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.surface import SURFACE_NUMBERS

TRAINED = make_config("medium", surface={"pattern": "plaid"})
MANY = make_config("medium", surface={"pattern": "drawn"})


@pytest.mark.parametrize(
    ("trained", "options", "says"),
    [
        (TRAINED, {}, []),
        (MANY, {"surface": {"pattern": "bricks"}}, []),
        (TRAINED, {"air": {"gusts_m_s": 5.0}}, []),
        (
            TRAINED,
            {"surface": {"pattern": "bricks"}},
            ["trained with surface.pattern plaid alone; with bricks it sees"],
        ),
        (TRAINED, {"env": {"speed_m_s": 8.0}}, ["trained with env.speed_m_s 4.0, not 8.0: how it flies so"]),
        (
            TRAINED,
            {"camera": {"horizontal_fov_deg": 60.0, "mount": "body"}, "env": {"speed_m_s": 2.0}},
            ["env.speed_m_s 4.0, not 2.0", "camera.horizontal_fov_deg 90.0, camera.mount level, not 60.0, body: how"],
        ),
    ],
)
def test_each_difference_that_matters_is_a_sentence_and_nothing_else_is(trained, options, says):
    found = describe_unseen(
        trained, make_config("medium", **{"surface": {"pattern": trained.surface.pattern}, **options})
    )
    assert len(found) == len(says) and all(each in line for each, line in zip(says, found, strict=True))


def test_a_world_with_patterns_of_its_own_is_unseen_by_a_policy_of_one_look(tmp_path: Path) -> None:
    stripes = "3 0.5 1 0 0 0.5 " + "0 " * (SURFACE_NUMBERS - 6)
    body = '<worldbody><geom name="it" type="box" size="1 1 1"/></worldbody>'
    plain, striped = tmp_path / "plain.xml", tmp_path / "striped.xml"
    plain.write_text(f"<mujoco>{body}</mujoco>")
    striped.write_text(f'<mujoco>{body}<custom><numeric name="surface:it" data="{stripes}"/></custom></mujoco>')
    assert describe_unseen(TRAINED, TRAINED, load_scene(plain)) == []
    (line,) = describe_unseen(TRAINED, TRAINED, load_scene(striped))
    assert "trained with surface.pattern plaid alone; the shapes of this world have patterns of their own" in line
    assert describe_unseen(MANY, MANY, load_scene(striped)) == []
    there = make_config(str(striped), surface={"pattern": "plaid"})
    assert describe_unseen(there, there, load_scene(striped)) == []  # it learnt there
