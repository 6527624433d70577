"""Policies on disk: what comes back, and what is refused."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.learn.policy import Policy, PolicyParams
from edqn_jax.runs.checkpoints import manifest
from edqn_jax.runs.checkpoints import params as checkpoints
from edqn_jax.runs.checkpoints.params import POLICY, load_params, save_params
from edqn_jax.runs.policies import save_policy


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


def test_a_policy_whose_saving_was_interrupted_does_not_exist(tmp_path):
    save_params(tmp_path, some_policy())
    (tmp_path / POLICY / manifest.MANIFEST).unlink()
    with pytest.raises(ConfigError, match="incomplete: it has no manifest.json, so saving it was interrupted"):
        load_params(tmp_path)


@pytest.mark.parametrize("fails", ["rename", "seal"])
@pytest.mark.parametrize("interrupted", [False, True])
def test_a_policy_is_there_until_the_next_one_is_whole(tmp_path, monkeypatch, fails, interrupted):
    save_params(tmp_path, some_policy(1.0))
    if interrupted:
        (tmp_path / POLICY).rename(tmp_path / f"{POLICY}.replaced")

    def full(*arguments):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(*((type(tmp_path), "rename") if fails == "rename" else (checkpoints.manifest, "seal")), full)
        with pytest.raises(ConfigError, match="cannot be written: No space left on device"):
            save_params(tmp_path, some_policy(2.0))
    assert same(load_params(tmp_path), some_policy(1.0))
    assert len(list(tmp_path.iterdir())) == 1


def test_a_policy_that_was_just_being_replaced_is_found(tmp_path):
    save_params(tmp_path, some_policy(1.0))
    (tmp_path / POLICY).rename(tmp_path / f"{POLICY}.replaced")  # and then the process was killed
    assert same(load_params(tmp_path), some_policy(1.0))
    save_params(tmp_path, some_policy(2.0))
    assert same(load_params(tmp_path), some_policy(2.0))
    assert [path.name for path in tmp_path.iterdir()] == [POLICY]


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


def test_a_damaged_policy_is_one_sentence(tmp_path):
    save_params(tmp_path, some_policy())
    (tmp_path / POLICY / "_METADATA").unlink()
    with pytest.raises(ConfigError, match="'_METADATA' is missing") as refusal:
        load_params(tmp_path)
    assert "\n" not in str(refusal.value)
