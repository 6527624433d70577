"""Hatchling's hook that compiles the library in C for a wheel, where there is a compiler.

Wheels hold one library for each kind of processor (`edqn_jax/native/shipped.py`). Without a compiler, and in editable
installs, there is none, and the wheel is one for any machine. CC names another compiler than `cc`, with its options.

XLA's header is that of the oldest jaxlib that the package works with: XLA calls what was compiled with an older minor
version of its interface.
"""

from __future__ import annotations

import os
import platform
import runpy
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface  # pyright: ignore[reportMissingImports]

HERE = Path(__file__).parent
"""With XLA's header below it."""


class CLibrary(BuildHookInterface):
    """Adds the library to wheels."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compiles the library, and says where it is and that the wheel is of this platform."""
        if version == "editable":
            return
        self.scratch = tempfile.TemporaryDirectory()
        root = Path(self.root)
        files = compile_library(root / "edqn_jax", Path(self.scratch.name))
        if files:
            build_data["pure_python"] = False
            build_data["tag"] = f"py3-none-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"
            build_data["force_include"] |= {str(file): f"edqn_jax/native/built/{file.name}" for file in files}

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Deletes what was compiled, which the wheel has."""
        del build_data, artifact_path
        if version != "editable":
            self.scratch.cleanup()


def compile_library(package: Path, folder: Path, machine: str = platform.machine()) -> list[Path]:
    """Compiles the library for each kind of processor of a machine.

    Args:
        package: folder of the package's sources.
        folder: for the files.
        machine: in the words of `platform.machine`.

    Returns:
        the libraries, and the file that names the compiler; none without a compiler, or if it can compile none.
    """
    shipped = runpy.run_path(str(package / "native" / "shipped.py"))
    compiler = shipped["find_compiler"]()
    if compiler is None or not sys.platform.startswith(("linux", "darwin")):
        return []
    sources = [str(package / source) for source in shipped["SOURCES"]]
    searched = [f"-I{HERE}", f"-I{package / 'native'}"]

    def compile_for(kind: str) -> Path | None:
        file = folder / shipped["library_of"](kind)
        command = [*compiler, *shipped["FLAGS"], f"-march={kind}", *searched, *sources, "-lm", "-o", str(file)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            first = next(iter(done.stderr.splitlines()), "it said nothing")
            print(f"the wheel has no library in C for {kind}: {first}", file=sys.stderr)
        return None if done.returncode else file

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        made = [file for file in pool.map(compile_for, shipped["KINDS"].get(machine, {})) if file is not None]
    if not made:
        return []
    named = folder / shipped["COMPILER"]
    said = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=False).stdout
    named.write_text(next(iter(said.splitlines()), shlex.join(compiler)) + "\n", encoding="utf-8")
    return [*made, named]
