"""Files that a command writes: checked beforehand, written atomically."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.files import check_can_make, check_can_write, write_atomically


@pytest.mark.parametrize("content", ["95 % \N{EN DASH} 97 %\n", b"\x00\xff"])
def test_text_and_bytes_are_written_as_they_are_and_nothing_else(content, tmp_path):
    write_atomically(tmp_path / "file", content)
    assert (tmp_path / "file").read_bytes() == (content.encode("utf-8") if isinstance(content, str) else content)
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_a_write_that_fails_leaves_the_old_file_and_no_part_of_the_new(tmp_path, monkeypatch):
    file = tmp_path / "file"
    write_atomically(file, "old")
    write_bytes = Path.write_bytes

    def half(self: Path, content: bytes) -> int:
        write_bytes(self, content[: len(content) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(ConfigError) as error:
        write_atomically(file, "new one")
    assert str(error.value) == f"'{file}' cannot be written: No space left on device"
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_what_can_be_written_is_let_pass_and_nothing_is_made(tmp_path):
    (tmp_path / "old").write_text("old")
    check_can_write(tmp_path / "old")
    check_can_write(tmp_path / "new")
    check_can_make(tmp_path)
    check_can_make(tmp_path / "deep" / "down")
    assert [file.name for file in tmp_path.iterdir()] == ["old"]
    assert (tmp_path / "old").read_text() == "old"


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("nowhere/file", "there is no folder '{folder}/nowhere'"),
        ("old/file", "there is no folder '{folder}/old'"),
        (".", "it is a folder"),
        ("x" * 250, "nothing can be created in '{folder}' (File name too long)"),
        ("x" * 300, "nothing can be created in '{folder}' (File name too long)"),
    ],
)
def test_a_file_that_cannot_be_written_is_named_with_the_reason(name, reason, tmp_path):
    (tmp_path / "old").write_text("old")
    file = tmp_path / name
    with pytest.raises(ConfigError) as error:
        check_can_write(file)
    assert str(error.value) == f"'{file}' cannot be written: {reason.format(folder=tmp_path)}"
    with pytest.raises(ConfigError, match="cannot be written"):
        write_atomically(file, "new")


@pytest.mark.parametrize("below", ["old", "old/folder", "old/deep/folder"])
def test_a_folder_below_a_file_cannot_be_made(below, tmp_path):
    (tmp_path / "old").write_text("old")
    with pytest.raises(ConfigError, match=f"'{tmp_path / below}' cannot be written: '{tmp_path / 'old'}' is not a"):
        check_can_make(tmp_path / below)


@pytest.mark.parametrize("check", [check_can_write, check_can_make])
def test_a_folder_in_which_nothing_can_be_made_is_named(check, tmp_path, monkeypatch):
    # The tests may run as root, who may write anywhere; so the answer of the system is made up.
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "mkdir", refuse)
    with pytest.raises(ConfigError) as error:
        check(tmp_path / "new")
    assert str(error.value) == (
        f"'{tmp_path / 'new'}' cannot be written: nothing can be created in '{tmp_path}' (Permission denied)"
    )
