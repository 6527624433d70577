"""The README's examples run as they are printed."""

from __future__ import annotations

import pytest

import edqn_jax
from tests.support.pages import ROOT, blocks_of


@pytest.mark.slow
def test_the_readmes_examples_run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = blocks_of(ROOT / "README.md", "python")
    flown: dict = {}
    exec(first, flown)
    x, y, z = map(float, flown["step"].flight.position[-1])
    # Ahead from (1, 1, 3), where the goal lies: both horizontal coordinates grow; the second move climbs too.
    assert int(flown["step"].outcome) == edqn_jax.Outcome.RUNNING and x > 1.5 and y > 1.5 and 3.1 < z < 4.5
    assert len(flown["environment"].events(flown["step"].observation)) > 0
    assert "(" in capsys.readouterr().out

    miniature = edqn_jax.make_config(
        "paper",
        train={"num_envs": 16, "total_steps": 1024, "chunk_steps": 32, "validation_missions": 4},
        agent={"batch_size": 16, "replay_size": 1024, "learning_starts": 256},
        camera={"width": 16, "height": 12},
        drone={"physics": "rigid_body"},
        env={"max_decisions": 40},
    )
    # The second example is given a configuration that trains in seconds.
    monkeypatch.setitem(vars(edqn_jax), "make_config", {"paper": miniature}.__getitem__)
    exec(second, {})
    assert "'missions': 100" in capsys.readouterr().out
