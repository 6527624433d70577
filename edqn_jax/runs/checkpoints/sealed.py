"""Arrays in one file, sealed by a SHA-256: what a policy and a checkpoint are on disk.

The file has the layout of safetensors, so that other programs read it too: eight bytes with the length of the header,
the header in JSON, the arrays' bytes. The header's `__metadata__` begins with the SHA-256 of the whole file, in which
its own digits count as zeros. So every bit is checked before anything of the file is used.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from edqn_jax.errors import ConfigError, DamagedError
from edqn_jax.files import write_error

SUFFIX = ".safetensors"

_KINDS = {
    **{"bool": "BOOL", "bfloat16": "BF16", "float16": "F16", "float32": "F32", "float64": "F64"},
    **{f"{sign}int{bits}": f"{sign or 'i'}{bits}".upper() for sign in ("", "u") for bits in (8, 16, 32, 64)},
}
_OPEN = "0" * 64  # the digits of a seal that is yet to be made
_SPARE = 10_000_000  # bytes that stay free on the disk, beside what a file takes


def write_sealed(file: Path, arrays: Mapping[str, Any], texts: Mapping[str, str]) -> None:
    """Replaces a file atomically; on return it is synced to the disk.

    Until then the previous file stays intact. Only the calling process writes, even if it is one of several.

    Args:
        file: its folder may be missing.
        arrays: by name.
        texts: kept beside them.

    Raises:
        ConfigError: if it cannot be written, or the disk has too little space for it.
    """
    whole = {name: np.asarray(array) for name, array in arrays.items()}
    # In this order all of them are aligned.
    held = dict(sorted(whole.items(), key=lambda item: -item[1].itemsize))
    header = _header(held, texts)
    data = [np.ascontiguousarray(array).reshape(-1).view(np.uint8).data for array in held.values()]
    summed = hashlib.sha256(header)
    for piece in data:
        summed.update(piece)
    partial = file.with_name(file.name + ".partial")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        _check_space(file.parent, len(header) + sum(map(len, data)))
        with partial.open("wb") as opened:
            opened.write(header.replace(_OPEN.encode(), summed.hexdigest().encode(), 1))
            for piece in data:
                opened.write(piece)
        sync_to_disk(partial)
        partial.replace(file)
        sync_to_disk(file.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise write_error(file, error.strerror) from None


def load_sealed(file: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Returns arrays and texts of a file that `write_sealed` wrote, after verifying its checksum.

    Raises:
        DamagedError: if a bit of it has changed, or it was cut.
        ConfigError: if it cannot be read.
    """
    if file.is_symlink() or not file.is_file():
        raise DamagedError(f"'{file}' is damaged: it is no file")
    try:
        held = bytearray(file.read_bytes())
    except OSError as error:
        raise ConfigError(f"'{file}' cannot be read: {error.strerror or 'unknown reason'}") from None
    try:
        begins = 8 + int.from_bytes(held[:8], "little")
        header = json.loads(held[8:begins])
        texts = header.pop("__metadata__")
        if not _is_seal(texts.pop("sha256"), held, begins):
            raise ValueError
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise DamagedError(f"'{file}' is damaged: it is not as it was saved") from None
    kinds = {name: kind for kind, name in _KINDS.items()}
    try:
        return {name: _array(held, begins, kinds[said["dtype"]], said) for name, said in header.items()}, texts
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
        raise ConfigError(f"'{file}' does not hold the arrays that it names") from None


def file_digest(file: Path) -> str:
    """Returns the SHA-256 of a file, in hexadecimal digits."""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def sync_to_disk(path: Path) -> None:
    """Syncs a file or folder to the disk; only files where folders cannot be synced."""
    if os.name == "nt" and path.is_dir():
        return
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def _header(arrays: Mapping[str, np.ndarray], texts: Mapping[str, str]) -> bytes:
    """Returns length and header of a file that is not sealed yet."""
    said: dict[str, Any] = {"__metadata__": {"sha256": _OPEN, **texts}}
    begins = 0
    for name, array in arrays.items():
        ends = begins + array.nbytes
        said[name] = {"dtype": _KINDS[str(array.dtype)], "shape": array.shape, "data_offsets": [begins, ends]}
        begins = ends
    text = json.dumps(said, allow_nan=False).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text


def _is_seal(seal: str, held: bytearray, begins: int) -> bool:
    """Returns whether a file of these bytes, whose arrays begin there, has this seal."""
    summed = hashlib.sha256(held[:begins].replace(seal.encode(), _OPEN.encode(), 1))
    summed.update(memoryview(held)[begins:])
    return summed.hexdigest() == seal


def _array(held: bytearray, begins: int, kind: str, said: Mapping[str, Any]) -> np.ndarray:
    first, end = said["data_offsets"]
    return np.frombuffer(memoryview(held)[begins + first : begins + end], kind).reshape(said["shape"])


def _check_space(folder: Path, needed: int) -> None:
    free = shutil.disk_usage(folder).free
    if free < needed + _SPARE:
        raise ConfigError(
            f"'{folder}' has {free / 1e6:,.0f} MB of free space, and {(needed + _SPARE) / 1e6:,.0f} MB are needed"
        )
