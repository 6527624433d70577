"""What a run keeps on disk to be flown again: the policy, as an Orbax checkpoint.

Saved synchronously: when `save_params` returns, the checkpoint is there and carries its commit marker. One
without the marker does not exist.
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
"""What Orbax writes into a checkpoint last of all."""


def save_params(folder: Path, params: PolicyParams) -> None:
    """Writes the policy into `folder`, a run's `checkpoints/`; one that is there already is replaced.

    The arrays are saved from the host: how many devices they lay on leaves no trace. The calling process saves
    alone, whether it is one of several or not.
    """
    tree = jax.tree.map(np.asarray, {"encoder": params.encoder, "q": params.q})
    here = jax.process_index()
    # Or Orbax would wait for the other processes.
    alone = ocp.options.MultiprocessingOptions(primary_host=here, active_processes={here})
    handler = ocp.PyTreeCheckpointHandler(multiprocessing_options=alone)
    saver = ocp.Checkpointer(handler, multiprocessing_options=alone)
    saver.save((folder / POLICY).absolute(), args=ocp.args.PyTreeSave(tree), force=True)


def load_params(folder: Path) -> PolicyParams:
    """The policy saved in `folder`, a run's `checkpoints/`; arrays on the host.

    Raises:
        ConfigError: if there is none, or it is incomplete.
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
