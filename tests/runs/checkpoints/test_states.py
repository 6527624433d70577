"""Checkpoints of a run: whole or not there, the newest good one first."""

from __future__ import annotations

import collections
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.runs.checkpoints import states
from edqn_jax.runs.checkpoints.states import Checkpoint
from tests.support.checkpoints import ARRAYS, file_name, newest, saved
from tests.support.processes import PATIENCE_S


def flip(file: Path, bit: int) -> None:
    content = bytearray(file.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    file.write_bytes(content)


@pytest.mark.parametrize("relative", [False, True])
def test_a_checkpoint_comes_back_bit_for_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, relative: bool) -> None:
    monkeypatch.chdir(tmp_path)
    folder = Path("run") if relative else tmp_path / "run"
    saved(folder, 7)
    found, said = newest(folder)
    assert found is not None and not said
    assert (found.host, found.config, found.facts) == ({"done": 7}, "train: {}\n", {"reward": "r"})
    for name, array in ARRAYS.items():
        assert found.arrays[name].dtype == array.dtype and found.arrays[name].shape == array.shape
        np.testing.assert_array_equal(found.arrays[name], array)


def test_the_newest_are_kept_and_what_an_interrupted_one_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / "step-000000003.safetensors.partial").touch()
    for step in (1, 2, 10):
        saved(tmp_path, step)
    assert sorted(place.name for place in tmp_path.iterdir()) == [file_name(2), file_name(10)]
    found, _ = newest(tmp_path)
    assert found is not None and found.arrays[".step"] == 10


def test_without_checkpoints_there_is_none(tmp_path: Path) -> None:
    assert newest(tmp_path / "nothing") == (None, [])


def test_no_flipped_bit_and_no_cut_file_is_loaded_and_the_one_before_is_used(tmp_path: Path) -> None:
    saved(tmp_path / "good", 1)
    saved(tmp_path / "good", 2)
    whole = tmp_path / "good" / file_name(2)
    size = whole.stat().st_size
    bits = np.random.default_rng(0).integers(0, 8 * size, 100).tolist()
    for damage in [*range(0, 64, 7), *bits, "cut", "longer", "empty"]:
        folder = tmp_path / "hurt"
        shutil.copytree(tmp_path / "good", folder)
        hurt = folder / whole.name
        if isinstance(damage, int):
            flip(hurt, damage)
        else:
            held = hurt.read_bytes()
            hurt.write_bytes({"cut": held[:-1], "longer": held + b"x", "empty": b""}[damage])
        found, said = newest(folder)
        assert found is not None and found.arrays[".step"] == 1, damage
        assert len(said) == 1 and "after training step 2 is set aside" in said[0]
        assert (folder / f"{whole.name}.damaged").is_file()
        shutil.rmtree(folder)


def test_other_programs_read_it_as_safetensors(tmp_path: Path) -> None:
    held = saved(tmp_path, 7).read_bytes()
    begins = 8 + int.from_bytes(held[:8], "little")
    header = json.loads(held[8:begins])
    assert begins % 8 == 0 and set(header) == {"__metadata__", *ARRAYS}
    assert all(isinstance(text, str) for text in header["__metadata__"].values())
    said = header[".actors.env"]
    first, end = said["data_offsets"]
    assert (said["dtype"], said["shape"]) == ("F32", [3, 4])
    np.testing.assert_array_equal(np.frombuffer(held[begins:][first:end], "<f4").reshape(3, 4), ARRAYS[".actors.env"])
    assert len(held) - begins == max(each["data_offsets"][1] for name, each in header.items() if name in ARRAYS)


def test_folders_of_an_older_version_are_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "step-000000002").mkdir()
    with pytest.raises(ConfigError, match="are folders, as older versions saved them; .* or give --resume never"):
        newest(tmp_path)


def test_where_all_are_damaged_the_run_is_not_quietly_begun_anew(tmp_path: Path) -> None:
    flip(saved(tmp_path, 1), 9)
    for _ in range(2):  # nor at the next start
        with pytest.raises(ConfigError, match="no checkpoint in .* can be used; --resume never begins the run anew"):
            newest(tmp_path)


def test_a_checkpoint_that_is_whole_keeps_its_name_whatever_else_is_wrong(tmp_path: Path) -> None:
    saved(tmp_path, 1)
    said: list[str] = []

    def unusable(checkpoint: Checkpoint) -> None:
        raise ConfigError("'metrics.jsonl' is lost")

    with pytest.raises(ConfigError, match="can be used"):
        states.newest_checkpoint(tmp_path, unusable, said.append)
    assert said == ["the checkpoint after training step 1 is passed over: 'metrics.jsonl' is lost"]
    assert newest(tmp_path)[0] is not None


def test_a_disk_with_too_little_space_is_noticed_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved(tmp_path, 1)
    usage = collections.namedtuple("usage", "free")
    monkeypatch.setattr("edqn_jax.runs.checkpoints.sealed.shutil.disk_usage", lambda folder: usage(5_000_000))
    with pytest.raises(ConfigError, match="has 5 MB of free space, and 10 MB are needed"):
        saved(tmp_path, 2)
    assert [place.name for place in tmp_path.iterdir()] == [file_name(1)]


FULL = """
import resource, sys
from pathlib import Path
from edqn_jax.errors import ConfigError
from tests.support.checkpoints import file_name, newest, saved
folder, failed = Path(sys.argv[1]), 0
saved(folder, 1)
most = max(file.stat().st_size for file in folder.rglob("*") if file.is_file())
for limit in range(0, most + 1, max(most // 12, 1)):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    try:
        saved(folder, 2)
    except ConfigError as error:
        failed += 1
        assert "cannot be written" in str(error), error
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    found, said = newest(folder)
    assert found is not None and not said
    names = {place.name for place in folder.iterdir()}
    assert names <= {file_name(1), file_name(2)}, names
    assert file_name(1) in names
print(failed)
"""


def test_a_disk_that_fills_at_any_write_leaves_the_checkpoint_before(tmp_path: Path) -> None:
    words = [sys.executable, "-c", FULL, str(tmp_path)]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert int(ended.stdout) >= 10


def test_growing_files_are_checked_and_cut_back_to_what_they_held(tmp_path: Path) -> None:
    files = {"a.csv": tmp_path / "a.csv", "later.csv": tmp_path / "later.csv"}
    files["a.csv"].write_text("1\n2\n")
    said = states.log_digests(files)
    files["a.csv"].write_text("1\n2\n3\n4")
    files["later.csv"].write_text("5\n")
    states.check_log_prefix(files, said)
    states.truncate_logs(files, said)
    assert files["a.csv"].read_text() == "1\n2\n" and not files["later.csv"].exists()
    for changed in ("1\n3\n", "1\n"):
        files["a.csv"].write_text(changed)
        with pytest.raises(ConfigError, match=r"a.csv' does not begin with what it held when it was saved"):
            states.check_log_prefix(files, said)
