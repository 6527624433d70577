"""Policies on disk, with checksums.

When `save_params` returns, the policy is complete and on the disk, and has taken the place of the one before, which is
whole until then. A policy without its manifest, or with a changed bit, is refused.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from edqn_jax.errors import ConfigError
from edqn_jax.files import unwritable
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.runs.checkpoints import arrays, manifest

POLICY = "policy"
"""The policy's folder within `checkpoints/`."""

CONFIG = "config_sha256"
"""The fact of a policy's manifest that says which `config.yaml` it was saved with."""


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
    saved, partial, replaced = _places(folder.absolute())
    arrays.clear(partial)
    facts = {} if config_file is None else {CONFIG: manifest.digest(config_file)}
    arrays.write(partial, {"encoder": params.encoder, "q": params.q}, facts)
    try:
        if saved.exists():  # if not, what is in the other place may be the only policy
            shutil.rmtree(replaced, ignore_errors=True)
            saved.rename(replaced)
        partial.rename(saved)
        manifest.sync(saved.parent)
        shutil.rmtree(replaced, ignore_errors=True)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise unwritable(saved, error.strerror) from None


def load_params(folder: Path, config_file: Path | None = None) -> PolicyParams:
    """Returns the policy saved in `folder`, a run's `checkpoints/`; arrays on the host.

    Args:
        folder: of the checkpoints.
        config_file: `config.yaml` beside it; refused if it is not the one that the policy was saved with.

    Raises:
        ConfigError: if there is none, or it is incomplete, damaged or unreadable.
    """
    saved = saved_at(folder)
    facts = manifest.check(saved)
    if config_file is not None and CONFIG in facts and facts[CONFIG] != manifest.digest(config_file):
        raise ConfigError(f"'{config_file}' has changed since the policy beside it was saved; put the old one back")
    tree = arrays.read(saved)
    if not isinstance(tree, dict) or set(tree) != {"encoder", "q"}:
        raise ConfigError(f"'{saved}' holds no policy: it has no encoder or no Q-network")
    return PolicyParams(encoder=tree["encoder"], q=tree["q"])


def saved_at(folder: Path) -> Path:
    """Returns the folder of the policy in a run's `checkpoints/`.

    Raises:
        ConfigError: if there is none.
    """
    saved, _, replaced = _places(folder.absolute())
    if not saved.is_dir() and replaced.is_dir():  # the process ended between two renames
        saved = replaced
    if not saved.is_dir():
        raise ConfigError(f"there is no policy in '{folder}'; a run saves one with its checkpoints and at its end")
    return saved


def _places(folder: Path) -> tuple[Path, Path, Path]:
    """Returns where a policy is, where it is while it is written, and where the one before is while it is replaced."""
    return folder / POLICY, folder / f"{POLICY}.partial", folder / f"{POLICY}.replaced"
