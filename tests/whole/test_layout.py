"""One device and eight: the same flights to the last bit, and the same parameters after one update."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from edqn_jax.sim.task.outcomes import Outcome
from tests.support.layout_process import CONFIG, DECISIONS, DEVICES
from tests.support.processes import PATIENCE_S, ROOT

pytestmark = pytest.mark.slow

Leaves = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def layouts(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Leaves]:
    """What each number of devices came to."""
    folder = tmp_path_factory.mktemp("layouts")
    words = [sys.executable, "-m", "tests.support.layout_process", str(folder)]
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "XLA_FLAGS": ""}  # the program that trains
    ended = subprocess.run(words, env=variables, capture_output=True, text=True, timeout=PATIENCE_S)
    assert ended.returncode == 0, ended.stderr
    return {count: dict(np.load(folder / f"{count}.npz")) for count in DEVICES}


def about(leaves: Leaves, *words: str) -> Leaves:
    """Those whose name begins with the first word and holds the others."""
    first, *others = words
    return {name: x for name, x in leaves.items() if name.startswith(first) and all(word in name for word in others)}


def test_the_rollout_goes_through_ends_and_resets_and_chance(layouts: dict[int, Leaves]) -> None:
    outcomes = np.stack(list(about(layouts[1], "seen", "outcome").values()))
    assert outcomes.shape[0] == DECISIONS and outcomes[0].size == CONFIG.train.num_envs
    assert {Outcome.RUNNING, Outcome.COLLISION, Outcome.TIME_OUT} <= set(outcomes.flat)
    assert (outcomes != Outcome.RUNNING).any(axis=0).all()  # every environment has been reset
    moves = layouts[1][f"flown/{DECISIONS}.replay.action"]
    assert len(np.unique(moves)) > 10
    codes = layouts[1][f"flown/{DECISIONS}.memory"][..., : CONFIG.encoder.code_size]
    assert np.ptp(codes.reshape(-1, CONFIG.encoder.code_size), axis=0).min() > 0.0


@pytest.mark.parametrize("devices", DEVICES[1:])
def test_rollouts_without_learning_are_equal_to_the_last_bit(layouts: dict[int, Leaves], devices: int) -> None:
    one, many = ({**about(layouts[count], "flown"), **about(layouts[count], "seen")} for count in (1, devices))
    assert one.keys() == many.keys()
    different = [name for name in one if one[name].tobytes() != many[name].tobytes()]
    assert not different


@pytest.mark.parametrize("devices", DEVICES[1:])
@pytest.mark.parametrize(("update", "learns"), [("dqn", "q"), ("vae", "vae")])
def test_parameters_agree_after_one_update(layouts: dict[int, Leaves], update: str, learns: str, devices: int) -> None:
    before, one, many = (
        about(layouts[count], f"{update}/{moment}.{learns}[")
        for count, moment in ((1, "before"), (1, "after"), (devices, "after"))
    )
    for old, (name, ours), theirs in zip(before.values(), one.items(), many.values(), strict=True):
        # Gradients are summed over the shards in another order: some units in the last place, 1e-7. Adam's first step
        # divides each by its own size, so where large terms nearly cancel, the difference grows as they cancel.
        # Reached: 3e-8, about float32's own.
        scale = np.abs(ours).max()
        assert not np.array_equal(ours, old), name
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-5 * scale, err_msg=name)
