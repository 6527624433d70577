"""Policies on disk, as Orbax checkpoints.

Saving is synchronous: when `save_params` returns, the checkpoint is complete and holds its commit marker. A
checkpoint without the marker is refused.
"""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp

from edqn_jax.errors import ConfigError
from edqn_jax.learn.policy import PolicyParams

POLICY = "policy"
"""The policy's folder within `checkpoints/`."""

COMMIT_MARKER = "commit_success.txt"
"""File that Orbax writes last; a checkpoint without it is incomplete."""


def save_params(folder: Path, params: PolicyParams) -> None:
    """Writes the policy into `folder`, a run's `checkpoints/`; replaces an existing one.

    Arrays are saved from the host, so the file does not depend on the number of devices. Only the calling
    process saves, even if it is one of several.
    """
    tree = jax.tree.map(np.asarray, {"encoder": params.encoder, "q": params.q})
    here = jax.process_index()
    # Without this Orbax waits for the other processes.
    alone = ocp.options.MultiprocessingOptions(primary_host=here, active_processes={here})
    handler = ocp.PyTreeCheckpointHandler(multiprocessing_options=alone)
    saver = ocp.Checkpointer(handler, multiprocessing_options=alone)
    saver.save((folder / POLICY).absolute(), args=ocp.args.PyTreeSave(tree), force=True)


def load_params(folder: Path) -> PolicyParams:
    """Returns the policy saved in `folder`, a run's `checkpoints/`; arrays on the host.

    Raises:
        ConfigError: if there is none, or it is incomplete or unreadable.
    """
    saved = (folder / POLICY).absolute()
    if not saved.is_dir():
        raise ConfigError(f"there is no policy in '{folder}'; a run saves one when its training ends")
    if not (saved / COMMIT_MARKER).is_file():
        raise ConfigError(f"the policy in '{saved}' is incomplete: saving it was interrupted")
    try:
        tree = ocp.PyTreeCheckpointer().restore(saved)
        return PolicyParams(encoder=tree["encoder"], q=tree["q"])
    except (OSError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ConfigError(f"the policy in '{saved}' cannot be read: {reason}") from None
