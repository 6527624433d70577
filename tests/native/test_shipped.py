"""The library in C that wheels bring: how it is built, which one is taken, and what it draws."""

from __future__ import annotations

import ctypes
import dataclasses
import runpy
import shutil
import sys
from pathlib import Path
from types import ModuleType
from typing import Literal

import jax
import numpy as np
import pytest

from edqn_jax.native import build, shipped
from edqn_jax.sim.camera import native
from edqn_jax.sim.camera.camera import LUMA_WEIGHTS
from tests.support.camera_in_c import CONFIG, ROUNDING, TIES, crowd, frames, in_c
from tests.support.processes import ROOT

X86 = [f"x86-64-v{level}" for level in (4, 3, 2)]


@pytest.fixture(scope="module")
def hook() -> dict:
    """The hook, without Hatchling."""
    full = "hatchling.builders.hooks.plugin.interface"
    parts = [full.rsplit(".", cut)[0] for cut in range(5)]
    with pytest.MonkeyPatch.context() as patch:
        for name in parts:
            patch.setitem(sys.modules, name, ModuleType(name))
        setattr(sys.modules[full], "BuildHookInterface", object)  # noqa: B010
        return runpy.run_path(str(ROOT / "scripts" / "wheel" / "hatch_build.py"))


def cpuinfo(tmp_path: Path, *flags: str) -> Path:
    file = tmp_path / "cpuinfo"
    file.write_text("".join(f"processor : 0\nflags\t\t: fpu {each}\n" for each in flags))
    return file


@pytest.fixture
def brought(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with all libraries, which are empty, on a processor of x86-64-v3."""
    for kind in X86:
        (tmp_path / shipped.library_of(kind)).touch()
    (tmp_path / shipped.COMPILER).write_text("cc 12\n")
    monkeypatch.setattr(shipped, "FOLDER", tmp_path)
    monkeypatch.setattr(shipped, "kinds_of_processor", lambda: X86[1:])
    monkeypatch.delenv(shipped.NAMED, raising=False)
    monkeypatch.delenv(shipped.SWITCH, raising=False)
    return tmp_path


def test_a_kind_needs_all_that_it_may_use_on_every_core(tmp_path: Path) -> None:
    old, usual, new = (" ".join(shipped.KINDS["x86_64"][kind]) for kind in reversed(X86))
    found = [shipped.kinds_of_processor("x86_64", cpuinfo(tmp_path, flags)) for flags in (new, usual, old, "sse2")]
    assert found == [X86, X86[1:], X86[2:], []]
    assert shipped.kinds_of_processor("x86_64", cpuinfo(tmp_path, new, old)) == X86[2:]
    assert shipped.kinds_of_processor("x86_64", cpuinfo(tmp_path, new.replace("avx512vl", ""))) == X86[1:]
    assert shipped.kinds_of_processor("x86_64", tmp_path / "none") == []
    assert shipped.kinds_of_processor("aarch64", tmp_path / "none") == ["armv8-a"]
    assert shipped.kinds_of_processor("riscv64", tmp_path / "none") == []


def test_the_fastest_that_runs_here_is_taken(brought: Path) -> None:
    assert shipped.shipped_library() == (X86[1], brought / "edqn-x86-64-v3.so")
    assert shipped.describe_library() == "for x86-64-v3, in the package"
    (brought / "edqn-x86-64-v3.so").unlink()
    assert shipped.shipped_library() == (X86[2], brought / "edqn-x86-64-v2.so")


def test_who_names_a_compiler_or_wants_none_of_it_does_without(brought: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build.compiler_version.cache_clear()
    assert build.compiler_version() == "cc 12, for x86-64-v3 in the wheel"
    build.compiler_version.cache_clear()
    monkeypatch.setenv(shipped.NAMED, "no-such-compiler")
    assert shipped.shipped_library() is None and shipped.describe_library() == "none, JAX does its work"
    assert build.compiler_version() is None
    build.compiler_version.cache_clear()
    monkeypatch.setenv(shipped.SWITCH, "0")
    assert shipped.shipped_library() is None and "EDQN_JAX_NATIVE=0" in shipped.describe_library()


def test_a_library_that_cannot_be_loaded_is_told_and_compiled_here(
    brought: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    source = brought / "again.c"
    source.write_text(
        '#include "handler.h"\n'
        "XLA_FFI_Error *edqn_test_again(XLA_FFI_CallFrame *call) { return asked_for_version(call) ? 0 : 0; }\n"
    )
    monkeypatch.setattr(build, "_SHIPPED_SOURCES", (source,))
    assert build.ensure_registered(source, ("edqn_test_again",)) is (shutil.which("cc") is not None)
    assert "again.c could not be compiled or loaded" in caplog.text and "too short" in caplog.text


def test_without_a_compiler_a_wheel_has_no_library(hook: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    assert hook["compile_library"](ROOT / "edqn_jax", tmp_path) == [] and not list(tmp_path.iterdir())


def test_what_a_compiler_cannot_compile_is_left_out(
    hook: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    knows_v2 = tmp_path / "old-cc"
    knows_v2.write_text(
        '#!/bin/sh\n[ "$1" = --version ] && echo "old cc 1.0" && exit\n'
        'case "$*" in *x86-64-v2*) for last; do :; done; echo > "$last";; *) echo "what is that" >&2; exit 1;; esac\n'
    )
    knows_v2.chmod(0o755)
    monkeypatch.setenv("CC", str(knows_v2))
    made = hook["compile_library"](ROOT / "edqn_jax", tmp_path, "x86_64")
    assert [file.name for file in made] == ["edqn-x86-64-v2.so", "compiler.txt"]
    assert made[-1].read_text() == "old cc 1.0\n"
    assert "no library in C for x86-64-v4: what is that" in capsys.readouterr().err


def test_an_editable_install_has_none_and_a_wheel_with_one_is_of_its_platform(
    hook: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    added = hook["CLibrary"]()
    added.root = str(ROOT)
    data: dict = {"force_include": {}}
    added.initialize("editable", data)
    assert data == {"force_include": {}}
    held = tmp_path / "edqn-x86-64-v3.so"
    monkeypatch.setitem(hook["CLibrary"].initialize.__globals__, "compile_library", lambda package, folder: [held])
    added.initialize("standard", data)
    assert data["force_include"] == {str(held): "edqn_jax/native/built/edqn-x86-64-v3.so"}
    assert not data["pure_python"] and data["tag"].startswith("py3-none-") and "-" not in data["tag"].split("-", 2)[2]
    added.finalize("standard", data, "")
    assert not Path(added.scratch.name).exists()


def test_xlas_header_is_no_newer_than_that_of_the_installed_jaxlib() -> None:
    def version(root: Path) -> list[str]:
        lines = (root / "xla" / "ffi" / "api" / "c_api.h").read_text(encoding="utf-8").splitlines()
        return [line for line in lines if line.startswith(("#define XLA_FFI_API_MAJOR", "#define XLA_FFI_API_MINOR"))]

    ours, theirs = version(ROOT / "scripts" / "wheel"), version(Path(jax.ffi.include_dir()))
    assert ours[0] == theirs[0] and int(ours[1].split()[-1]) <= int(theirs[1].split()[-1])


@pytest.mark.whole
@pytest.mark.slow
@pytest.mark.parametrize("mount", ["level", "body"])
def test_all_kinds_draw_what_is_drawn_by_one_compiled_here(
    mount: Literal["level", "body"], hook: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those with fused products and sums to the bit of each other; compilers fuse otherwise for one processor alone."""
    if not native.is_available("cpu"):
        return
    config = dataclasses.replace(CONFIG, mount=mount)
    scene, origin, rotation = frames([crowd(np.random.default_rng(3))], 64, seed=4)
    weights = np.broadcast_to(np.asarray(LUMA_WEIGHTS, np.float32), origin.shape)
    call = native._call
    drawn = {"here": in_c(call, config, scene, origin, rotation, weights)}
    hook["compile_library"](ROOT / "edqn_jax", tmp_path)
    for kind in shipped.kinds_of_processor():
        library, named = ctypes.CDLL(str(tmp_path / shipped.library_of(kind))), f"{mount}_{kind}"
        assert library.edqn_field_rays and library.edqn_all_sum and library.edqn_adam
        for target in native.TARGETS:
            jax.ffi.register_ffi_target(f"{named}_{target}", jax.ffi.pycapsule(library[target]), platform="cpu")
        monkeypatch.setattr(native, "_call", lambda target, *given, named=named: call(f"{named}_{target}", *given))
        drawn[kind] = in_c(native._call, config, scene, origin, rotation, weights)
    assert len(drawn) > 1
    for pictures, depths in drawn.values():
        assert np.mean(~np.isclose(pictures, drawn["here"][0], atol=ROUNDING)) < TIES
        np.testing.assert_allclose(depths, drawn["here"][1], rtol=1e-5)
    for a, b in zip(drawn.get(X86[0], ()), drawn.get(X86[1], ()), strict=False):
        np.testing.assert_array_equal(a, b)
