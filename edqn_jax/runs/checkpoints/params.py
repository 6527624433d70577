"""Policies on disk, each one sealed file.

When `save_params` returns, the policy is complete and on the disk, and has taken the place of the one before, which is
whole until then. A policy with a changed bit is refused.
"""

from __future__ import annotations

from pathlib import Path

from flax.traverse_util import flatten_dict, unflatten_dict

from edqn_jax.errors import ConfigError
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.runs.checkpoints import sealed
from edqn_jax.runs.checkpoints.sealed import file_digest

POLICY = f"policy{sealed.SUFFIX}"
"""The policy's file within `checkpoints/`."""

CONFIG = "config_sha256"
"""The text in a policy's file that says which `config.yaml` it was saved with."""


def save_params(folder: Path, params: PolicyParams, config_file: Path | None = None) -> None:
    """Writes the policy into `folder`, a run's `checkpoints/`; replaces an existing one.

    Arrays are saved from the host, so the file does not depend on the number of devices.

    Args:
        folder: of the checkpoints.
        params: of the policy.
        config_file: `config.yaml` that the policy belongs to; its digest is kept.

    Raises:
        ConfigError: if it cannot be written; a policy that was there is there still.
    """
    facts = {} if config_file is None else {CONFIG: file_digest(config_file)}
    sealed.write_sealed(folder / POLICY, flatten_dict({"encoder": params.encoder, "q": params.q}, sep="/"), facts)


def load_params(folder: Path, config_file: Path | None = None) -> PolicyParams:
    """Returns the policy saved in `folder`, a run's `checkpoints/`; arrays on the host.

    Args:
        folder: of the checkpoints.
        config_file: `config.yaml` beside it; refused if it is not the one that the policy was saved with.

    Raises:
        ConfigError: if there is none, or it is damaged or unreadable.
    """
    saved = policy_file(folder)
    arrays, facts = sealed.load_sealed(saved)
    if config_file is not None and CONFIG in facts and facts[CONFIG] != file_digest(config_file):
        raise ConfigError(f"'{config_file}' has changed since the policy beside it was saved; put the old one back")
    tree = {"encoder": {}, **unflatten_dict(arrays, sep="/")}
    if set(tree) != {"encoder", "q"}:
        raise ConfigError(f"'{saved}' holds no policy: it has no Q-network, or more than a policy has")
    return PolicyParams(encoder=tree["encoder"], q=tree["q"])


def policy_file(folder: Path) -> Path:
    """Returns the file of the policy in a run's `checkpoints/`.

    Raises:
        ConfigError: if there is none.
    """
    if (folder / POLICY).is_file():
        return folder / POLICY
    if (folder / "policy").is_dir():
        raise ConfigError(
            f"the policy in '{folder}' is a folder, as older versions saved them; this one reads '{POLICY}' alone: fly "
            "it with the version that saved it"
        )
    raise ConfigError(f"there is no policy in '{folder}'; a run saves one with its checkpoints and at its end")
