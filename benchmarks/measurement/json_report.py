"""The entries that the JSON reports of all benchmarks share, and how reports are written."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edqn_jax.devices.hardware import describe_processor
from edqn_jax.files import write_atomically
from edqn_jax.runs.directory import to_plain_json
from edqn_jax.runs.provenance import package_versions


def machine(devices: Sequence[Any]) -> dict[str, Any]:
    """Returns device and versions for a report measured on `devices`."""
    return {
        "device": describe_processor() if devices[0].platform == "cpu" else devices[0].device_kind,
        "devices": [str(device) for device in devices],
        "versions": package_versions(),
    }


def write(file: Path | None, report: dict[str, Any]) -> None:
    """Writes the report atomically, where a file is named.

    Raises:
        ConfigError: if the file cannot be written.
    """
    if file is not None:
        write_atomically(file, json.dumps(to_plain_json(report), indent=1, allow_nan=False) + "\n")
