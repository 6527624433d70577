"""Compiled programs that are kept from one command to the next, in JAX's persistent cache."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import warnings
from pathlib import Path
from typing import Any

import jax

MOST_BYTES = 2**30
"""Of kept programs; beyond this the older half of them goes."""


def keep_programs() -> None:
    """Makes JAX keep what it compiles for the next command; must be called before anything is compiled.

    The folder is one for this kind of processor under `$XDG_CACHE_HOME/edqn_jax`, by default `~/.cache/edqn_jax`.
    Nothing is kept where that cannot be written, or with JAX_ENABLE_COMPILATION_CACHE=false; and whoever gives
    JAX_COMPILATION_CACHE_DIR has a folder of their own. A damaged program is compiled again.
    """
    options: Any = jax.config
    if options.jax_compilation_cache_dir or not options.jax_enable_compilation_cache:
        return
    try:
        folder = _folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            return
        _make_room(folder, MOST_BYTES)
    except (OSError, RuntimeError):  # there is no home
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    for what in ("reading", "writing"):  # it is compiled then, or not kept
        warnings.filterwarnings("ignore", f"Error {what} persistent compilation cache entry", UserWarning)


def _folder() -> Path:
    """Returns where programs are kept: those of one processor may not run on another."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(given) if os.path.isabs(given) else Path.home() / ".cache"
    return root / "edqn_jax" / f"programs-{hashlib.sha256(_abilities().encode()).hexdigest()[:12]}"


def _abilities() -> str:
    """Returns what tells processors apart that do not run the same programs."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.is_file() else []
    kinds = sorted({line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))})
    return "\n".join([platform.machine(), platform.processor(), *kinds])


def _make_room(folder: Path, most: int) -> None:
    """Removes the older half of a folder's bytes where they are more than `most`."""
    files = [(file, file.stat()) for file in folder.iterdir() if file.is_file()]
    left = sum(status.st_size for _, status in files)
    if left <= most:
        return
    for file, status in sorted(files, key=lambda each: each[1].st_mtime):
        if left <= most // 2:
            break
        with contextlib.suppress(FileNotFoundError):  # another command makes room as well
            file.unlink()
        left -= status.st_size
