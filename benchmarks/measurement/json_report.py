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
from measurement.conditions import Watch, conditions, sentence

WATCH = Watch()
"""From the import of this module on."""


def machine(devices: Sequence[Any]) -> dict[str, Any]:
    """Returns device and versions for a report measured on `devices`."""
    return {
        "device": describe_processor() if devices[0].platform == "cpu" else devices[0].device_kind,
        "devices": [str(device) for device in devices],
        "versions": package_versions(),
    }


def write(file: Path | None, report: dict[str, Any]) -> None:
    """Prints the processor and the conditions of a report in a line, and writes both with it, where a file is named.

    Raises:
        ConfigError: if the file cannot be written.
    """
    about = _about(report)
    print(f"{about['processor']}: {sentence(about['conditions'])}")
    if file is not None:
        _write(file, report | about)


def write_row(file: Path, row: dict[str, Any]) -> None:
    """Writes one of several reports that a benchmark reads again, with processor and conditions.

    Raises:
        ConfigError: if the file cannot be written.
    """
    _write(file, row | _about(row))


def _about(report: dict[str, Any]) -> dict[str, Any]:
    """Returns the processor, and the conditions that the report has, else those since the benchmark began."""
    return {"processor": describe_processor(), "conditions": report.get("conditions") or conditions(WATCH)}


def _write(file: Path, report: dict[str, Any]) -> None:
    write_atomically(file, json.dumps(to_plain_json(report), indent=1, allow_nan=False) + "\n")
