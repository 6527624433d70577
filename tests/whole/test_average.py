"""`scripts/average.py`: the mean of two policies that flies best in the validation worlds."""

from __future__ import annotations

import dataclasses
import json
from importlib import import_module
from pathlib import Path
from types import ModuleType

import jax
import numpy as np
import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.runs.policies import load_policy, save_policy
from tests.support.configs import TINY


@pytest.fixture
def average(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "scripts"))
    return import_module("average")


@pytest.fixture
def two(tmp_path: Path) -> tuple[Policy, Policy]:
    """Policies of which the second's configuration lets velocity change slowly."""
    slow = dataclasses.replace(TINY, env=dataclasses.replace(TINY.env, setpoint_m_s2=4.0))
    first, second = Policy(TINY, fresh_policy(TINY, 0)), Policy(slow, fresh_policy(slow, 1))
    save_policy(first, tmp_path / "first")
    save_policy(second, tmp_path / "second")
    return first, second


def test_the_mean_that_arrives_most_often_under_both_conditions_is_kept(
    tmp_path: Path, two: tuple[Policy, Policy], average: ModuleType, monkeypatch, capsys
) -> None:
    first, second = two
    asked = []

    def success(policy: Policy, conditions, world: str, missions: int) -> float:
        share, *ends = (sum(float(x.sum()) for x in jax.tree.leaves(each.params)) for each in (policy, *two))
        asked.append((conditions.env.setpoint_m_s2, world, missions))
        return 1.0 - abs((share - ends[0]) / (ends[1] - ends[0]) - 0.25)  # best at a quarter of the second

    monkeypatch.setattr(average, "success", success)
    words = [str(tmp_path / name) for name in ("first", "second")]
    more = ["--worlds", "sparse", "rooms", "--missions", "8", "--weights", "0", "0.25", "1"]
    assert average.main([*words, "--out", str(tmp_path / "mean"), *more]) == 0
    kept = load_policy(tmp_path / "mean")
    assert kept.config == second.config
    jax.tree.map(
        lambda found, a, b: np.testing.assert_allclose(found, 0.75 * a + 0.25 * b, rtol=1e-6),
        kept.params,
        first.params,
        second.params,
    )
    assert asked[:4] == [(0.0, "sparse", 8), (0.0, "rooms", 8), (4.0, "sparse", 8), (4.0, "rooms", 8)]
    with pytest.raises(SystemExit):  # before anything is flown
        average.main([*words, "--out", str(tmp_path / "mean")])
    assert len(asked) == 12
    assert [json.loads(line)["weight"] for line in capsys.readouterr().out.splitlines()] == [0.0, 0.25, 1.0]


def test_policies_of_other_shapes_have_no_mean(two: tuple[Policy, Policy], average: ModuleType) -> None:
    wider = dataclasses.replace(TINY, agent=dataclasses.replace(TINY.agent, hidden=(32,)))
    with pytest.raises(ConfigError, match="networks of other shapes"):
        average.mean_of(two[0], Policy(wider, fresh_policy(wider)), 0.5)


@pytest.mark.slow
def test_success_is_of_the_validation_worlds(two: tuple[Policy, Policy], average: ModuleType) -> None:
    assert 0.0 <= average.success(two[0], TINY, "sparse", 4) <= 1.0
