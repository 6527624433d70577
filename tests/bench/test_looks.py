"""A row of the table of looks, and a report of the smallest kind."""

from __future__ import annotations

import json

import pytest

from edqn_jax.config import EXACT
from edqn_jax.config.loading import to_yaml, with_conditions
from edqn_jax.runs.checkpoints.params import save_params
from edqn_jax.sim.physics.disturbances import any_on
from tests.support.policies import CONFIG, always

import looks  # isort: skip


def test_every_look_has_a_row_with_success_and_the_decoders_error(tmp_path, capsys):
    (tmp_path / "config.yaml").write_text(to_yaml(CONFIG))
    save_params(tmp_path / "checkpoints", always((1, 0, 0)))
    words = ["--policy", str(tmp_path), "--world", "medium", "--looks", "blank", "--missions", "1"]
    assert looks.main([*words, "--json", str(tmp_path / "looks.json")]) == 0
    (look,) = json.loads((tmp_path / "looks.json").read_text())["looks"]
    assert look["pattern"] == "blank" and look["decoder"]["frames"] > 0
    assert looks.row(look) in capsys.readouterr().out


@pytest.mark.parametrize("group, option", [(group, option) for group in EXACT for option in EXACT[group]])
def test_an_exact_flight_has_no_disturbance(group, option):
    disturbed = with_conditions(
        CONFIG, {group: {option: {"drag": True, "action_delay": 1}.get(option, 0.1)}}, "evaluate"
    )
    assert any_on(disturbed) and not any_on(with_conditions(disturbed, EXACT, "evaluate"))


def test_a_policy_without_a_decoder_has_dashes():
    figures = {"pattern": "wood", "success_rate": 0.5, "interval": [0.2, 0.8], "collisions": 3}
    assert looks.row(figures) == "| `wood` | 50.0% (20.0 to 80.0) | 3 | – | – | – |"


def test_a_look_that_does_not_exist_is_refused(capsys):
    with pytest.raises(SystemExit):
        looks.parse(["--looks", "brick"])
    assert "invalid choice: 'brick'" in capsys.readouterr().err
