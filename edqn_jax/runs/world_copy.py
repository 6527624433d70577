"""A run's own copy of the world files that it trains and flies in, so that what it was measured in stays.

`world/name/` and `world/flown/` hold the files of `world.name` and `world.flown`, where these are no random worlds; a
manifest in `world/` has their digests.
"""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

from edqn_jax.config import DENSITIES, Config, WorldConfig
from edqn_jax.errors import ConfigError
from edqn_jax.runs import manifest
from edqn_jax.runs.files import unwritable
from edqn_jax.sim.mjcf import SceneError, resolve_world
from edqn_jax.sim.mjcf_files import files_of

WORLD = "world"
"""The folder of the copies within that of a run."""

_ROLES = ("name", "flown")


def keep(folder: Path, config: Config) -> None:
    """Copies the files of a run's worlds into its folder; what was there is replaced.

    Raises:
        ConfigError: if a world has no file, or a copy cannot be written.
    """
    copies = folder / WORLD
    try:
        shutil.rmtree(copies, ignore_errors=True)
        facts = {}
        for role in _roles(config.world):
            world = resolve_world(getattr(config.world, role)).resolve()
            facts[role] = world.name
            for file in files_of(world):
                copy = copies / role / file.relative_to(world.parent)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, copy)
        if facts:
            manifest.seal(copies, facts)
    except OSError as error:
        raise unwritable(copies, error.strerror) from None


def flown_in(folder: Path, config: Config) -> tuple[Config, list[str]]:
    """Returns a run's configuration with its copies in place of worlds that are missing or others now.

    Args:
        folder: of the run; without copies, as in a folder that `save_policy` wrote, nothing changes.
        config: its configuration.

    Returns:
        configuration, and a sentence for each world that is replaced.

    Raises:
        ConfigError: if the copies are damaged.
    """
    world, notes = config.world, []
    for role, why, copy in _changed(folder, config):
        notes.append(f"the world '{getattr(world, role)}' {why}; the run's own copy is flown, '{copy}'")
        world = dataclasses.replace(world, **{role: str(copy)})
    return dataclasses.replace(config, world=world), notes


def check_unchanged(folder: Path, config: Config) -> None:
    """Raises unless the worlds of a run that is to be continued are those that it was begun in.

    Raises:
        ConfigError: says where the run's own copy is.
    """
    changed = _changed(folder, config)
    if changed:
        role, why, copy = changed[0]
        raise ConfigError(f"the world '{getattr(config.world, role)}' {why}; put back the run's own copy, '{copy}'")


def _changed(folder: Path, config: Config) -> list[tuple[str, str, Path]]:
    """Returns of each world that differs from its copy its role, how it differs, and the copy."""
    if not (folder / WORLD).is_dir():
        return []
    facts, changed = manifest.check(folder / WORLD), []
    for role in _roles(config.world):
        if role not in facts:
            raise ConfigError(f"'{folder / WORLD}' has no copy of the world '{getattr(config.world, role)}'")
        copy = folder / WORLD / role / facts[role]
        why = _difference(getattr(config.world, role), copy)
        if why is not None:
            changed.append((role, why, copy))
    return changed


def _roles(world: WorldConfig) -> list[str]:
    """Returns which of a run's worlds come from files."""
    return [role for role in _ROLES if getattr(world, role) and getattr(world, role) not in DENSITIES]


def _difference(name: str, copy: Path) -> str | None:
    """Returns how a world on the disk differs from a copy of it; None if it does not."""
    try:
        file = resolve_world(name).resolve()
        files = files_of(file)
    except SceneError:
        return "is missing or no world any more"
    there = {str(each.relative_to(file.parent)): manifest.digest(each) for each in files}
    folder = copy.resolve().parent
    here = {str(each.relative_to(folder)): manifest.digest(each) for each in files_of(copy)}
    return None if there == here else "has changed since the run began"
