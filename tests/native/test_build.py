"""Compiling C on the user's machine, and doing without."""

from __future__ import annotations

import shutil
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from edqn_jax.native import build, shipped
from edqn_jax.native.build import ensure_registered

SOURCE = """
#include "handler.h"
XLA_FFI_Error *NAME(XLA_FFI_CallFrame *call) { return asked_for_version(call) ? 0 : failed(call, 2, "nothing"); }
"""


@pytest.fixture
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv(shipped.SWITCH, raising=False)
    file = tmp_path / "nothing.c"
    file.write_text(SOURCE, encoding="utf-8")
    return file


def kept(tmp_path: Path) -> list[Path]:
    return sorted((tmp_path / "cache").rglob("*.so"))


@pytest.mark.parametrize("named", ["no-such-compiler", "'", 'cc "-O'])
def test_without_a_compiler_nothing_is_registered(
    named: str, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", named)
    assert not ensure_registered(source, ("edqn_test_a",), ("NAME=edqn_test_a",)) and not kept(tmp_path)


def test_it_can_be_switched_off(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(shipped.SWITCH, "0")
    assert not ensure_registered(source, ("edqn_test_b",), ("NAME=edqn_test_b",)) and not kept(tmp_path)


def test_a_source_that_does_not_compile_leaves_nothing(source: Path, tmp_path: Path) -> None:
    source.write_text("no C at all", encoding="utf-8")
    assert not ensure_registered(source, ("edqn_test_c",), ("NAME=edqn_test_c",)) and not kept(tmp_path)


def test_a_compiler_that_writes_no_library_is_as_none(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "cc"
    words = '#!/bin/sh\nfor last; do :; done\n[ "$last" = --version ] || echo nothing > "$last"\n'
    broken.write_text(words, encoding="utf-8")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    assert not ensure_registered(source, ("edqn_test_d",), ("NAME=edqn_test_d",))


def test_what_is_compiled_once_is_kept(source: Path, tmp_path: Path) -> None:
    names = ("edqn_test_e",)
    if ensure_registered(source, names, ("NAME=edqn_test_e",)):
        (first,) = kept(tmp_path)
        made = first.stat().st_mtime_ns
        build._registered.cache_clear()
        assert ensure_registered(source, names, ("NAME=edqn_test_e",))
        assert kept(tmp_path) == [first] and first.stat().st_mtime_ns == made


def test_who_needs_one_library_does_not_wait_for_another(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, may_end = threading.Event(), threading.Event()

    def registered(of: Path, *_: object) -> bool:
        if of == source:
            begun.set()
            return may_end.wait(60)
        return True

    monkeypatch.setattr(build, "_registered", registered)
    monkeypatch.setattr(build, "_USED", {})
    with ThreadPoolExecutor(2) as pool:
        large = pool.submit(ensure_registered, source, ("edqn_test_large",))
        assert begun.wait(60)
        try:
            small = pool.submit(ensure_registered, tmp_path / "other.c", ("edqn_test_small",))
            assert small.result(60) and not large.done()
        finally:
            may_end.set()
        assert large.result(60)


def test_where_nothing_can_be_kept_it_is_compiled_and_leaves_nothing(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "private_folder", lambda: None)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    assert ensure_registered(source, ("edqn_test_f",), ("NAME=edqn_test_f",)) is (shutil.which("cc") is not None)
    assert not list(scratch.rglob("*")) and not kept(tmp_path)


def test_a_damaged_library_is_made_anew(source: Path, tmp_path: Path) -> None:
    command = build._command(build.C)
    if command is not None:
        folders = tmp_path / "whole", tmp_path / "damaged"
        for folder in folders:
            folder.mkdir()
        build._load_library(command, build.C.flags, source, ("NAME=edqn_test_g",), folders[0])
        (whole,) = folders[0].iterdir()
        # In another folder: a library that is loaded already is not read again.
        damaged = folders[1] / whole.name
        damaged.write_bytes(whole.read_bytes()[:100])
        assert build._load_library(command, build.C.flags, source, ("NAME=edqn_test_g",), folders[1]).edqn_test_g
        assert list(folders[1].iterdir()) == [damaged] and damaged.stat().st_size == whole.stat().st_size


def test_a_library_that_says_that_it_cannot_be_used_here_is_not(source: Path, caplog: pytest.LogCaptureFixture) -> None:
    usable = "const char *edqn_unusable_nothing(void) { return 0; }\n"
    source.write_text(SOURCE + usable, encoding="utf-8")
    compiler = shutil.which("cc") is not None
    assert ensure_registered(source, ("edqn_test_k",), ("NAME=edqn_test_k",)) is compiler and not caplog.records
    source.write_text(SOURCE + usable.replace("return 0", 'return "the driver is too old"'), encoding="utf-8")
    assert not ensure_registered(source, ("edqn_test_l",), ("NAME=edqn_test_l",))
    assert ("JAX does its work more slowly: the driver is too old" in caplog.text) is compiler


def test_what_an_included_header_says_is_compiled_anew_when_it_changes(source: Path, tmp_path: Path) -> None:
    header = source.with_name("name.h")
    for count, name in enumerate(("edqn_test_m", "edqn_test_n")):
        header.write_text(f"#define NAME {name}\n", encoding="utf-8")
        source.write_text('#include "name.h"\n' + SOURCE, encoding="utf-8")
        compiler = shutil.which("cc") is not None
        assert ensure_registered(source, (name,), (), build.C, (header,)) is compiler
        assert len(kept(tmp_path)) == (count + 1 if compiler else 0)


def test_the_compiler_may_have_options_and_a_failure_is_told(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("CC", "cc -DBEFORE=1")
    build.compiler_version.cache_clear()
    if shutil.which("cc") is None:
        assert build.compiler_version() is None
        return
    source.write_text(SOURCE.replace("#include", "#if BEFORE != 1\n#error no option\n#endif\n#include"))
    assert ensure_registered(source, ("edqn_test_h",), ("NAME=edqn_test_h",)) and not caplog.records
    assert not ensure_registered(source, ("edqn_test_j",), ("NAME=other_name",))
    assert "nothing.c could not be compiled or loaded, JAX does its work more slowly" in caplog.text
    monkeypatch.setenv(shipped.SWITCH, "0")
    build.compiler_version.cache_clear()
    assert build.compiler_version() is None
    build.compiler_version.cache_clear()
