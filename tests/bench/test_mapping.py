"""The benchmark of the growing map: what its rows count, what a map had of what was hit, and its options."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import mapping
from edqn_jax.errors import ConfigError
from edqn_jax.learn.policy import Policy
from edqn_jax.runs.policies import save_policy
from edqn_jax.sim.scene.mjcf import load_world
from rivals.mapping.pilot import TUNED
from tests.support.policies import CONFIG, fresh

WORLD = """<mujoco><worldbody>
  <geom type="box" pos="6 5 2" size="1 5 2"/>
  <site name="start" pos="2 5 2"/><site name="goal" pos="9 5 2"/>
  <site name="volume" type="box" pos="5 5 2" size="5 5 2"/>
</worldbody></mujoco>"""


def test_options_go_to_the_part_that_has_them() -> None:
    base = TUNED["decoded"]
    changed = mapping.with_options(base, ["cell_m=0.25", "touch_m=0.9", "reach_m=1.5", "speed_m_s=3", "looks_ahead=0"])
    assert (changed.map.cell_m, changed.route.touch_m, changed.follow.reach_m) == (0.25, 0.9, 1.5)
    assert changed.speed_m_s == 3 and changed.looks_ahead is False
    assert dataclasses.replace(changed.map, cell_m=base.map.cell_m) == base.map
    for words, says in (
        (["cells=1"], "there is no option 'cells'"),
        (["cell_m=small"], "NAME=NUMBER"),
        (["cell_m=0"], "cell_m of a map must be more than 0"),
        (["depth=1"], "there is no option 'depth'"),
    ):
        with pytest.raises(ConfigError, match=says):
            mapping.with_options(base, words)


def test_what_a_map_had_of_a_place_that_was_hit(tmp_path: Path) -> None:
    (tmp_path / "wall.xml").write_text(WORLD)
    scene = load_world(tmp_path / "wall.xml").scene
    touching = np.array([5.0 - 0.36, 5.25, 2.25], np.float32)

    def had(log_odds: np.ndarray) -> str:
        return mapping.look_up_contact(log_odds, 0.5, scene, touching, 0.36)

    log_odds = np.zeros((20, 20, 8))
    assert had(log_odds) == mapping.UNSEEN
    log_odds[:9] = -1.0
    log_odds[2, 10, 4] = 1.0  # occupied, but elsewhere
    assert had(log_odds) == mapping.UNSEEN
    log_odds[9] = -1.0  # up to the wall's face at x = 5
    assert had(log_odds) == mapping.TAKEN_FOR_FREE
    log_odds[10, 10, 4] = 1.0
    assert had(log_odds) == mapping.KNOWN


@pytest.mark.slow
def test_all_methods_fly_the_same_missions(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(mapping, "use_cpu_devices", lambda: None)
    short = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, max_decisions=4))
    save_policy(Policy(short, fresh(short, 0)), tmp_path / "policy")
    file, figure = tmp_path / "report.json", tmp_path / "map.png"
    words = ["--policy", str(tmp_path / "policy"), "--worlds", "forest", "--calls", "2", "--batch", "2"]
    assert mapping.main([*words, "--missions", "3", "--json", str(file)]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert [row["method"] for row in rows] == ["true", "decoded", "learned"]
    for row in rows:
        ends = row["successes"] + row["collisions"] + row["left_volume"] + row["timeouts"]
        assert ends == row["missions"] == len(row["arrived"]) == 3
        assert row["decision_p99_ms"] >= row["decision_ms"] > 0
        if row["method"] != "learned":
            assert sum(row["hit"].values()) == row["collisions"]
    assert rows[0]["options"]["depth"] == "true"
    shown = capsys.readouterr().out
    assert shown.count("| forest |") == 3 and "learned agent" in shown
    assert mapping.main([*words, "--methods", "true", "--figure", str(figure)]) == 0
    assert figure.read_bytes().startswith(b"\x89PNG") and "after 4 decisions" in capsys.readouterr().out


def test_what_cannot_be_measured_is_a_sentence(tmp_path: Path, capsys) -> None:
    assert mapping.main(["--policy", str(tmp_path)]) == 2
    assert "there is no run in" in capsys.readouterr().err
    for words, says in (
        (["--figure", "map.pdf"], "must end in .png or .gif"),
        (["--figure", "map.png", "--methods", "learned"], "the learned agent has none"),
        (["--missions", "0"], "--missions must be at least 1"),
    ):
        with pytest.raises(SystemExit):
            mapping.main(words)
        assert says in capsys.readouterr().err
