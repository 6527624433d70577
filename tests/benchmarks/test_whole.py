"""The training step that benchmarks time: past its beginning, and learning in every chunk."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from edqn_jax.evaluation.missions import run_missions
from measurement.flags import parse_config
from measurement.whole import WholeStep, steady
from tests.support.miniature import MINIATURE, WORLD


@pytest.mark.slow
def test_what_is_timed_is_training_past_its_beginning(monkeypatch: pytest.MonkeyPatch) -> None:
    quick = ("--drone.physics", "rigid_body", "--world", str(WORLD))  # what is timed is no claim about these
    config = steady(parse_config((*MINIATURE, *quick)), 4)
    whole = WholeStep(config, run_missions(config).training.env_params, jax.devices()[:2])
    # Three chunks, to warm up and to fill the replay: what is timed from here on is all alike.
    assert whole.done == 12 >= whole.trainer.schedule.learn_from
    before = jax.tree.map(np.asarray, (whole.state.learner.agent.q, whole.state.learner.vae))
    assert whole.turn() > 0
    after = jax.tree.map(np.asarray, (whole.state.learner.agent.q, whole.state.learner.vae))
    assert all(jax.tree.leaves(jax.tree.map(lambda a, b: np.any(a != b), before, after)))
    assert int(whole.state.step) == whole.done == 16
    assert whole.temporary_bytes > 0
    # A chunk in which nothing learnt must not pass for a fast one.
    idle = SimpleNamespace(metrics={"q_loss": np.array([np.nan]), "reconstruction_loss": np.array([1.0])})
    monkeypatch.setattr(whole.trainer, "chunk", lambda state, first: (state, (None, idle)))
    with pytest.raises(RuntimeError, match="did not learn throughout"):
        whole.turn()
