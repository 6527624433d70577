"""Policies that come with the package, each a folder as `save_policy` writes it, with a model card, and functions."""

from __future__ import annotations

import difflib
import re
from pathlib import Path

from edqn_jax.errors import ConfigError

PRETRAINED, LOOKS = "pretrained", "pretrained-looks"
LATE, BODY = "pretrained-late", "pretrained-body"
"""Names of the policies for random worlds, open and closed ones: of one plaid, and of surfaces of any look; of any look
also where moves may be late, and with a camera on the body."""

SHIPPED = (PRETRAINED, LOOKS, LATE, BODY)


def function_named(name: str | Path) -> tuple[str, str] | None:
    """Returns module or file, and what is in it, of `module:name` or `path/to/file.py:name`; None of anything else.

    A folder of that name takes precedence.
    """
    found = re.fullmatch(r"(.+\.py|[A-Za-z_][\w.]*):([A-Za-z_]\w*)", str(name))
    return None if found is None or Path(name).is_dir() else (found[1], found[2])


def policy_folder(run: Path) -> Path:
    """Returns the folder of a policy that comes with the package for its name, and any other folder as it is.

    A folder of that name in the current one takes precedence.
    """
    return Path(__file__).parent / run if str(run) in SHIPPED and not run.is_dir() else run


def no_run(folder: Path) -> ConfigError:
    """Returns the error of a folder that holds no run, or of one that is not there."""
    if folder.is_dir():
        return ConfigError(f"there is no run in '{folder}': it holds no config.yaml")
    if folder.is_file():
        return ConfigError(f"'{folder}' is a file; give the folder of a run")
    near = difflib.get_close_matches(str(folder), SHIPPED)
    return ConfigError(
        f"there is no run in '{folder}': " + (f"did you mean '{near[0]}'?" if near else "no such folder")
    )
