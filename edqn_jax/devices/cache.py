"""Compiled programs that are kept from one command to the next, in JAX's persistent cache."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import stat
import warnings
from pathlib import Path
from typing import Any

import jax

from edqn_jax.devices.hardware import count_cores
from edqn_jax.files import cache_folder

MAX_BYTES = 2**30
"""Of kept programs; beyond this those used longest ago are deleted."""


_enabled: list[Path] = []  # the folder, once this process keeps programs in it
_trimmed: set[Path] = set()  # folders in which this process has made room


def enable_compilation_cache() -> None:
    """Enables JAX's persistent compilation cache; must be called before anything is compiled.

    The folder is one for this kind of processor under `$XDG_CACHE_HOME/edqn_jax`, by default `~/.cache/edqn_jax`.
    Nothing is kept where that cannot be written, or with JAX_ENABLE_COMPILATION_CACHE=false; and whoever gives
    JAX_COMPILATION_CACHE_DIR has a folder of their own. A damaged program is compiled again, and JAX warns of it
    in every run until its file is deleted.
    """
    options: Any = jax.config
    if options.jax_compilation_cache_dir or not options.jax_enable_compilation_cache:
        return
    folder = private_folder()
    if folder is None:
        return
    _enabled.append(folder)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    # Such as on a full disk: the program is not kept, and nothing else is lost.
    warnings.filterwarnings("ignore", "Error writing persistent compilation cache entry", UserWarning)
    # Another command has deleted its copy of a program in the meantime, see `kept_programs`.
    deleted = "(?s)Error reading persistent compilation cache entry for 'jit_kept_.*FileNotFoundError"
    warnings.filterwarnings("ignore", deleted, UserWarning)


def enabled_folder() -> Path | None:
    """Returns the folder in which this process keeps programs; None if it keeps none, or in a folder of the user's."""
    return _enabled[-1] if _enabled else None


def private_folder() -> Path | None:
    """Creates and returns the cache folder for this kind of CPU, trimmed to its size limit by the first call.

    None where it cannot be written, or where others may write: what is in it is run.
    """
    try:
        folder = _folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
        foreign = hasattr(os, "getuid") and status.st_uid != os.getuid()
        if foreign or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            return None
        if not os.access(folder, os.W_OK):
            return None
        if folder not in _trimmed:  # of a full one this takes tenths of a second
            _make_room(folder, MAX_BYTES)
            _trimmed.add(folder)
    except (OSError, RuntimeError):  # there is no home
        return None
    return folder


def _folder() -> Path:
    """Returns where programs are kept: those of one processor may not run on another."""
    return cache_folder() / f"programs-{hashlib.sha256(_cpu_fingerprint().encode()).hexdigest()[:12]}"


def _cpu_fingerprint() -> str:
    """Returns a fingerprint of the CPU, for programs compiled for it."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.is_file() else []
    kinds = sorted({line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))})
    return "\n".join([platform.machine(), platform.processor(), f"{count_cores()} cores", *kinds])


def _make_room(folder: Path, most: int) -> None:
    """Deletes the files used longest ago, down to half of `most` bytes, if a folder holds more than `most`."""
    files = []
    for place, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(FileNotFoundError):  # another command makes room as well
                files.append((os.path.join(place, name), os.stat(os.path.join(place, name))))
    left = sum(status.st_size for _, status in files)
    if left <= most:
        return
    # Where no times of reading are written, these are of writing.
    for file, status in sorted(files, key=lambda each: max(each[1].st_atime, each[1].st_mtime)):
        if left <= most // 2:
            break
        Path(file).unlink(missing_ok=True)
        left -= status.st_size
