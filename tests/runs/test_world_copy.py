"""A run's own copy of its worlds."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from edqn_jax.config.loading import make_config
from edqn_jax.errors import ConfigError
from edqn_jax.runs import world_copy
from tests.support.miniature import WORLD


@pytest.fixture
def world(tmp_path: Path) -> Path:
    return Path(shutil.copy(WORLD, tmp_path / "mine.xml"))


def test_what_is_unchanged_is_flown_where_it_is(tmp_path: Path, world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = make_config("sparse", world={"flown": str(world)})
    monkeypatch.chdir(tmp_path)
    for folder in (tmp_path, Path()):
        world_copy.copy_worlds(folder, config)
        assert world_copy.with_copied_worlds(folder, config) == (config, [])
        world_copy.check_unchanged(folder, config)
    assert (tmp_path / "world" / "flown.xml").read_bytes() == WORLD.read_bytes()


@pytest.mark.parametrize("missing", [False, True])
def test_what_is_missing_or_another_one_is_flown_from_the_copy(tmp_path: Path, world: Path, missing: bool) -> None:
    config = make_config(str(world))
    world_copy.copy_worlds(tmp_path, config)
    if missing:
        world.unlink()
    else:
        world.write_text(world.read_text() + "\n<!-- another one -->")
    found, (note,) = world_copy.with_copied_worlds(tmp_path, config)
    copy, why = tmp_path / "world" / "name.xml", "is missing" if missing else "has changed since the run began"
    assert note == f"the world '{world}' {why}; the run's own copy is flown, '{copy}'"
    assert found.world.name == str(copy) and copy.read_bytes() == WORLD.read_bytes()
    with pytest.raises(ConfigError, match=re.escape(f"{why}; put back the run's own copy, '{copy}'")):
        world_copy.check_unchanged(tmp_path, config)


def test_a_damaged_copy_is_refused(tmp_path: Path, world: Path) -> None:
    config = make_config(str(world))
    world_copy.copy_worlds(tmp_path, config)
    copy = tmp_path / "world" / "name.xml"
    copy.write_text(copy.read_text() + "\n")
    with pytest.raises(ConfigError, match=r"is damaged: 'name\.xml' is missing, new or not as it was copied"):
        world_copy.with_copied_worlds(tmp_path, config)
    copy.unlink()
    copy.symlink_to("/dev/zero")
    with pytest.raises(ConfigError, match=r"is damaged: 'name\.xml' is no file"):
        world_copy.with_copied_worlds(tmp_path, config)
    copy.unlink()
    (tmp_path / "world" / world_copy.SUMS).unlink()
    with pytest.raises(ConfigError, match="is incomplete: it has no SHA256SUMS"):
        world_copy.with_copied_worlds(tmp_path, config)


def test_random_worlds_have_no_copy_and_old_runs_need_none(tmp_path: Path, world: Path) -> None:
    random = make_config("sparse", world={"flown": ""})
    world_copy.copy_worlds(tmp_path, random)
    assert not list(tmp_path.glob("world*"))
    assert world_copy.with_copied_worlds(tmp_path, make_config(str(world)))[1] == []
