"""Policies that come with the package, each a folder as `save_policy` writes it, with a model card."""

from __future__ import annotations

from pathlib import Path

PRETRAINED = "pretrained"
"""Name of the policy for open random worlds."""


def policy_folder(run: Path) -> Path:
    """Returns the folder of a policy that comes with the package for its name, and any other folder as it is.

    A folder of that name in the current one takes precedence.
    """
    return Path(__file__).parent / PRETRAINED if str(run) == PRETRAINED and not run.is_dir() else run
