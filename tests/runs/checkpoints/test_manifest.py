"""A sealed folder is used as it was sealed, or not at all."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.learn.policy import Policy
from edqn_jax.runs.checkpoints import manifest
from edqn_jax.runs.checkpoints.manifest import MANIFEST, check, seal
from edqn_jax.runs.policies import load_policy, save_policy
from tests.policies import CONFIG, always

FLIPS = 200


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "sealed" / "d").mkdir(parents=True)
    (tmp_path / "sealed" / "first").write_bytes(bytes(range(256)))
    (tmp_path / "sealed" / "d" / "empty").touch()
    seal(tmp_path / "sealed", {"of": "a test"})
    return tmp_path / "sealed"


def test_what_was_sealed_is_found_whole_and_says_what_it_is(folder: Path) -> None:
    assert check(folder) == {"of": "a test"}


def test_a_folder_is_incomplete_until_it_is_sealed(folder: Path) -> None:
    (folder / MANIFEST).unlink()
    with pytest.raises(ConfigError, match="is incomplete: it has no manifest.json"):
        check(folder)


def test_files_that_are_missing_new_changed_or_links_are_named(folder: Path) -> None:
    (folder / "d" / "empty").unlink()
    with pytest.raises(ConfigError, match="'d/empty' is missing"):
        check(folder)
    (folder / "d" / "empty").touch()
    (folder / "d" / "more").touch()
    with pytest.raises(ConfigError, match="'d/more' was not saved with it"):
        check(folder)
    (folder / "d" / "more").unlink()
    (folder / "first").write_bytes(bytes(255))
    with pytest.raises(ConfigError, match="'first' is not as it was saved"):
        check(folder)
    (folder / "first").unlink()
    (folder / "first").symlink_to("/dev/zero")
    with pytest.raises(ConfigError, match="'first' is neither a file nor a folder"):
        check(folder)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"facts": {}, "files": {}}',
        '{"facts": [], "files": 7, "sha256": ""}',
        "[" * 100_000,
        " " * 2_000_000,
        '{"facts": {}, "files": {"../../etc/passwd": {"bytes": 1, "sha256": ""}}, "sha256": ""}',
    ],
)
def test_a_manifest_that_we_did_not_write_is_damaged(folder: Path, text: str) -> None:
    (folder / MANIFEST).write_text(text)
    with pytest.raises(ConfigError, match=r"manifest.json' is damaged: it is not as it was saved"):
        check(folder)


def test_what_a_stranger_sealed_stays_in_its_folder(folder: Path) -> None:
    """A manifest that is right in itself and names files elsewhere: nothing outside the folder is looked at."""
    outside = folder.parent / "outside"
    outside.write_text("secret")
    shutil.copy(outside, folder / "copy")
    seal(folder)
    content = json.loads((folder / MANIFEST).read_text())
    (folder / "copy").unlink()
    content["files"]["../outside"] = content["files"].pop("copy")
    (folder / MANIFEST).write_text(manifest._text({"facts": {}, "files": content["files"]}))
    with pytest.raises(ConfigError, match=r"'\.\./outside' is missing"):
        check(folder)


def test_no_flipped_bit_and_no_cut_file_of_a_policy_is_loaded(tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    save_policy(Policy(CONFIG, always((1, 0, 0))), whole)
    load_policy(whole)
    files = sorted(path.relative_to(whole) for path in whole.rglob("*") if path.is_file())
    rng = np.random.default_rng(0)
    sizes = np.array([(whole / file).stat().st_size for file in files], float)
    chosen = [*range(len(files)), *rng.choice(len(files), FLIPS - len(files), p=sizes / sizes.sum())]
    for number, index in enumerate(chosen):
        damaged = whole / files[index]
        held = damaged.read_bytes()
        if number % 4 == 3:
            damaged.write_bytes(held[: rng.integers(len(held))])
        else:
            bit = int(rng.integers(8 * len(held)))
            changed = bytearray(held)
            changed[bit // 8] ^= 1 << bit % 8
            damaged.write_bytes(changed)
        with pytest.raises(ConfigError) as refusal:
            load_policy(whole)
        assert "\n" not in str(refusal.value)
        damaged.write_bytes(held)
    load_policy(whole)
