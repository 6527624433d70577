"""Policies on disk: what comes back, and what is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.learn.policy import Policy, PolicyParams
from edqn_jax.runs.checkpoints import sealed
from edqn_jax.runs.checkpoints.params import POLICY, load_params, save_params
from edqn_jax.runs.policies import load_policy, save_policy
from tests.support.marks import in_whole
from tests.support.policies import CONFIG, always


def some_policy(value: float = 1.0) -> PolicyParams:
    return PolicyParams(
        encoder={"encoder": {"table": jnp.full((2, 5, 3), value)}, "decoder": {"bias": jnp.arange(4.0)}},
        q={"Dense_0": {"kernel": jnp.full((3, 2), -value), "bias": jnp.zeros(2)}},
    )


def same(one: PolicyParams, other: PolicyParams) -> bool:
    equal = jax.tree.map(lambda a, b: a.dtype == b.dtype and np.array_equal(a, b), one, other)
    return jax.tree.structure(one) == jax.tree.structure(other) and all(jax.tree.leaves(equal))


def test_a_policy_comes_back_bit_for_bit(tmp_path):
    params = some_policy(0.1)
    save_params(tmp_path, params)
    assert same(load_params(tmp_path), params)


def test_saving_again_replaces_the_policy(tmp_path):
    save_params(tmp_path, some_policy(1.0))
    save_params(tmp_path, some_policy(2.0))
    assert same(load_params(tmp_path), some_policy(2.0))


def test_a_policy_from_two_devices_comes_back_on_the_host(tmp_path):
    mesh = Mesh(np.asarray(jax.devices()[:2]), ("env",))
    save_params(tmp_path, jax.device_put(some_policy(), NamedSharding(mesh, PartitionSpec())))
    loaded = load_params(tmp_path)
    assert same(loaded, some_policy())
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(loaded))


def test_no_policy_is_a_sentence(tmp_path):
    with pytest.raises(ConfigError, match=f"there is no policy in '{tmp_path}'"):
        load_params(tmp_path)


@pytest.mark.parametrize("fails", ["replace", "fsync"])
def test_a_policy_is_there_until_the_next_one_is_whole(tmp_path, monkeypatch, fails):
    save_params(tmp_path, some_policy(1.0))

    def full(*arguments):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(type(tmp_path) if fails == "replace" else sealed.os, fails, full)
        with pytest.raises(ConfigError, match="cannot be written: No space left on device"):
            save_params(tmp_path, some_policy(2.0))
    assert same(load_params(tmp_path), some_policy(1.0))
    assert [path.name for path in tmp_path.iterdir()] == [POLICY]


def test_a_policy_without_an_encoder_comes_back(tmp_path):
    blind = dataclasses.replace(some_policy(), encoder={})
    save_params(tmp_path, blind)
    assert same(load_params(tmp_path), blind)


def test_a_folder_of_an_older_version_is_a_sentence(tmp_path):
    (tmp_path / "policy").mkdir()
    with pytest.raises(ConfigError, match="is a folder, as older versions saved them; .* the version that saved it"):
        load_params(tmp_path)


def test_a_configuration_that_was_changed_afterwards_is_refused(tmp_path):
    file = tmp_path / "config.yaml"
    file.write_text("events: {threshold: 0.03}")
    save_params(tmp_path, some_policy(), file)
    load_params(tmp_path, file)
    file.write_text("events: {threshold: 0.02}")
    with pytest.raises(ConfigError, match="config.yaml' has changed since the policy beside it was saved"):
        load_params(tmp_path, file)


def test_a_policy_is_saved_into_no_folder_that_holds_files(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ConfigError, match="holds files already"):
        save_policy(Policy(Config(), some_policy()), tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]
    save_policy(Policy(Config(), some_policy()), tmp_path / "new")
    assert same(load_params(tmp_path / "new" / "checkpoints"), some_policy())


@pytest.mark.parametrize("flips", [40, *in_whole(200)])
def test_no_flipped_bit_and_no_cut_file_of_a_policy_is_loaded(flips: int, tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    save_policy(Policy(CONFIG, always((1, 0, 0))), whole)
    load_policy(whole)
    files = sorted(path.relative_to(whole) for path in whole.rglob("*") if path.is_file())
    rng = np.random.default_rng(0)
    sizes = np.array([(whole / file).stat().st_size for file in files], float)
    chosen = [*range(len(files)), *rng.choice(len(files), flips - len(files), p=sizes / sizes.sum())]
    for number, index in enumerate(chosen):
        damaged = whole / files[index]
        held = damaged.read_bytes()
        if number % 4 == 3:
            damaged.write_bytes(held[: rng.integers(len(held))])
        else:
            bit = int(rng.integers(8 * len(held)))
            changed = bytearray(held)
            changed[bit // 8] ^= 1 << bit % 8
            damaged.write_bytes(changed)
        with pytest.raises(ConfigError) as refusal:
            load_policy(whole)
        assert "\n" not in str(refusal.value)
        damaged.write_bytes(held)
    load_policy(whole)
