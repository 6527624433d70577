"""Compiled programs are kept between commands, where they may be, and a damaged one is no harm."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from edqn_jax.devices import cache

COMMAND = """
import jax
from edqn_jax.devices.cache import enable_compilation_cache
enable_compilation_cache()
print(jax.jit(lambda x: x * 3 + 1)(2.0), jax.config.jax_compilation_cache_dir)
"""


def outcome_of(warned: str = "", **variables: str) -> tuple[str, str]:
    """Returns what a process prints that keeps programs: the result, and the folder or None; it warns of `warned`."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XDG_"))}
    done = subprocess.run([sys.executable, "-c", COMMAND], env=kept | variables, capture_output=True, text=True)
    assert done.returncode == 0 and bool(done.stderr) == bool(warned) and warned in done.stderr, done.stderr
    result, folder = done.stdout.split()
    return result, folder


@pytest.mark.whole
def test_what_one_process_compiles_the_next_one_reads_and_what_is_damaged_is_compiled_again(tmp_path: Path) -> None:
    _, folder = outcome_of(XDG_CACHE_HOME=str(tmp_path))
    kept = sorted(Path(folder).iterdir())
    assert kept and Path(folder).is_relative_to(tmp_path / "edqn_jax")
    times = [file.stat().st_mtime_ns for file in kept]
    assert outcome_of(XDG_CACHE_HOME=str(tmp_path)) == ("7.0", folder)
    assert sorted(Path(folder).iterdir()) == kept and [file.stat().st_mtime_ns for file in kept] == times
    for file in kept:
        file.write_bytes(file.read_bytes()[:-20])
    assert outcome_of("Error reading persistent compilation", XDG_CACHE_HOME=str(tmp_path)) == ("7.0", folder)


@pytest.mark.whole
@pytest.mark.parametrize(
    ("name", "error", "shown"),
    [
        ("jit_kept_flights", "FileNotFoundError", False),
        ("jit_kept_flights", "ZstdError", True),
        ("jit_flights", "FileNotFoundError", True),
    ],
)
def test_a_copy_that_another_command_deleted_is_not_warned_of(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, error: str, shown: bool
) -> None:
    message = f"Error reading persistent compilation cache entry for '{name}': {error}: [Errno 2]\nno such file"
    monkeypatch.setattr(sys.modules[__name__], "COMMAND", f"{COMMAND}\nimport warnings\nwarnings.warn({message!r})")
    outcome_of("Error reading persistent" if shown else "", XDG_CACHE_HOME=str(tmp_path))


@pytest.mark.whole
def test_nothing_is_read_that_others_could_have_written(tmp_path: Path) -> None:
    _, folder = outcome_of(XDG_CACHE_HOME=str(tmp_path))
    Path(folder).chmod(0o777)
    assert outcome_of(XDG_CACHE_HOME=str(tmp_path)) == ("7.0", "None")


@pytest.mark.parametrize(
    ("variables", "folder"),
    [
        ({"JAX_COMPILATION_CACHE_DIR": "own"}, "own"),
        ({"JAX_ENABLE_COMPILATION_CACHE": "false"}, "None"),
        ({"XDG_CACHE_HOME": "/dev/null"}, "None"),
    ],
)
def test_nothing_is_kept_where_it_may_not_be(variables: dict[str, str], folder: str, tmp_path: Path) -> None:
    placed = {name: value.replace("own", str(tmp_path)) for name, value in variables.items()}
    assert outcome_of(**{"XDG_CACHE_HOME": str(tmp_path / "cache")} | placed) == (
        "7.0",
        folder.replace("own", str(tmp_path)),
    )
    assert not (tmp_path / "cache").exists()


def test_the_programs_used_longest_ago_go_once_there_are_too_many_bytes(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    read, written = (5, 1, 3, 2, 0, 4), (4, 2, 3, 2, 3, 0)  # days ago
    for number, ages in enumerate(zip(read, written, strict=True)):
        file = tmp_path / "folder" / f"{number}"
        file.write_bytes(bytes(100))
        last_read, last_written = (1_000_000 - 86_400 * age for age in ages)
        os.utime(file, (last_read, last_written))
    cache._make_room(tmp_path, 600)
    assert len(list((tmp_path / "folder").iterdir())) == 6
    cache._make_room(tmp_path, 599)
    assert sorted(file.name for file in (tmp_path / "folder").iterdir()) == ["4", "5"]


def test_room_is_made_once_in_a_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[Path] = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache, "_make_room", lambda folder, _: looked.append(folder))
    first = cache.private_folder()
    assert first is not None and cache.private_folder() == first and looked == [first]
