"""A run's own copy of the world files that it trains and flies in, so that what it was measured in stays.

`world/name.xml` and `world/flown.xml` are the files of `world.name` and `world.flown`, where these are no random
worlds, with the numbers of the meshes that they name; `SHA256SUMS` beside them has their digests, as `sha256sum
--check` reads them.
"""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

from edqn_jax.config import FAMILIES, Config, WorldConfig
from edqn_jax.errors import ConfigError, DamagedError
from edqn_jax.files import write_error
from edqn_jax.runs.checkpoints.sealed import file_digest, sync_to_disk
from edqn_jax.sim.scene.mjcf import SceneError, resolve_world
from edqn_jax.sim.scene.mjcf_parts.files import self_contained_bytes

COPIES = "world"
"""The folder of the copies within that of a run."""

SUMS = "SHA256SUMS"
"""File with the digests, which is written last."""

_ROLES = ("name", "flown")


def copy_worlds(folder: Path, config: Config) -> None:
    """Copies the files of a run's worlds into its folder, in place of all earlier copies.

    Raises:
        ConfigError: if a world has no file, or a copy cannot be written.
    """
    copies = folder / COPIES
    partial = copies.with_name(f"{COPIES}.partial")
    try:
        for place in (partial, copies):
            shutil.rmtree(place, ignore_errors=True)
        roles = _roles(config.world)
        if roles:
            partial.mkdir()
            for role in roles:
                content = self_contained_bytes(resolve_world(getattr(config.world, role)))
                (partial / f"{role}.xml").write_bytes(content)
            (partial / SUMS).write_text(_sums(partial), encoding="utf-8")
            for path in (*partial.iterdir(), partial):
                sync_to_disk(path)
            partial.rename(copies)
    except OSError as error:
        raise write_error(copies, error.strerror) from None


def with_copied_worlds(folder: Path, config: Config) -> tuple[Config, list[str]]:
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
    for role, why, copy in _changed_worlds(folder, config):
        notes.append(f"the world '{getattr(world, role)}' {why}; the run's own copy is flown, '{copy}'")
        world = dataclasses.replace(world, **{role: str(copy)})
    return dataclasses.replace(config, world=world), notes


def check_unchanged(folder: Path, config: Config) -> None:
    """Raises ConfigError if the worlds of a continued run have changed since it began.

    Raises:
        ConfigError: says where the run's own copy is.
    """
    changed = _changed_worlds(folder, config)
    if changed:
        role, why, copy = changed[0]
        raise ConfigError(f"the world '{getattr(config.world, role)}' {why}; put back the run's own copy, '{copy}'")


def _changed_worlds(folder: Path, config: Config) -> list[tuple[str, str, Path]]:
    """Returns role, difference and copy of each world that differs from its copy."""
    if not (folder / COPIES).is_dir():
        return []
    _check(folder / COPIES)
    found = []
    for role in _roles(config.world):
        name, copy = getattr(config.world, role), folder / COPIES / f"{role}.xml"
        if not copy.is_file():
            raise ConfigError(f"'{folder / COPIES}' has no copy of the world '{name}'")
        try:
            if self_contained_bytes(resolve_world(name)) != copy.read_bytes():
                found.append((role, "has changed since the run began", copy))
        except (SceneError, OSError):
            found.append((role, "is missing", copy))
    return found


def _check(copies: Path) -> None:
    """Raises ConfigError if a copy has changed since it was made.

    Raises:
        DamagedError: names the first one that is not.
        ConfigError: if one cannot be read.
    """
    try:
        if not (copies / SUMS).is_file():
            raise DamagedError(f"'{copies}' is incomplete: it has no {SUMS}")
        made, found = (copies / SUMS).read_bytes()[:1_000_000].decode(errors="replace"), _sums(copies)
    except OSError as error:
        raise ConfigError(f"'{copies}' cannot be read: {error.strerror or 'unknown reason'}") from None
    changed = sorted(set(made.splitlines()) ^ set(found.splitlines()))
    if changed:
        raise DamagedError(f"'{copies}' is damaged: '{changed[0][66:]}' is missing, new or not as it was copied")


def _sums(copies: Path) -> str:
    """Returns name and digest of each of the copies, a line each."""
    for path in copies.iterdir():
        if path.is_symlink() or not path.is_file():
            raise DamagedError(f"'{copies}' is damaged: '{path.name}' is no file")
    names = sorted(path.name for path in copies.iterdir() if path.name != SUMS)
    return "".join(f"{file_digest(copies / name)}  {name}\n" for name in names)


def _roles(world: WorldConfig) -> list[str]:
    """Returns which of a run's worlds come from files."""
    return [role for role in _ROLES if getattr(world, role) and getattr(world, role) not in FAMILIES]
