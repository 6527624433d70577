"""Figures of many hours and days: each run adds a row to a file, whose medians are shown.

A shared machine has quiet hours and others, so that the figure of one run is that of its hour.
"""

from __future__ import annotations

import datetime
import statistics
import subprocess
from pathlib import Path
from typing import Any

from edqn_jax.errors import ConfigError
from edqn_jax.files import write_atomically

FIELDS: tuple[str, ...] = (
    "time",
    "commit",
    "processor",
    "options",
    "decisions_per_second",
    "over_c_mujoco_rollout",
    "compile_seconds",
    "product_gflops",
    "cores_busy_with_others",
    "steal",
)
"""Columns of the file, separated by tabs: time is UTC, processor the device, options are those after `--`."""

FIGURES = {
    "decisions_per_second": "decisions/s",
    "over_c_mujoco_rollout": "of C MuJoCo's rate",
    "compile_seconds": "s of compiling",
}


def row_of(report: dict[str, Any], options: list[str]) -> dict[str, str]:
    """Returns the row of a report of `throughput.py` that was made now."""
    seen, whole = report["conditions"], report["rows"][0]
    others, steal = seen["cores_busy_with_others"], seen["steal"]
    return {
        "time": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M"),
        "commit": _commit(),
        "processor": report["device"],
        "options": " ".join(options) or "-",
        "decisions_per_second": f"{report['decisions_per_second']:.0f}",
        "over_c_mujoco_rollout": f"{whole['over_c_mujoco_rollout']:.4f}",
        "compile_seconds": f"{report['compile_seconds']:.1f}",
        "product_gflops": f"{seen['product_flops'] / 1e9:.0f}",
        "cores_busy_with_others": "-" if others is None else f"{others:.2f}",
        "steal": "-" if steal is None else f"{steal:.4f}",
    }


def read(file: Path) -> list[dict[str, str]]:
    """Returns the rows of a file; none if there is no such file.

    Raises:
        ConfigError: if it is no such table.
    """
    if not file.exists():
        return []
    head, *lines = file.read_text(encoding="utf-8").splitlines() or [""]
    rows = [dict(zip(FIELDS, line.split("\t"), strict=False)) for line in lines]
    if tuple(head.split("\t")) != FIELDS or any(len(row) != len(FIELDS) for row in rows):
        raise ConfigError(f"{file} is no table of runs; its first line must be {' '.join(FIELDS)}, separated by tabs")
    return rows


def add(file: Path, row: dict[str, str]) -> list[dict[str, str]]:
    """Adds a row to a file, which is made if need be, and returns all rows.

    Raises:
        ConfigError: if the file is no such table, or cannot be written.
    """
    rows = [*read(file), row]
    write_atomically(file, "".join("\t".join(line) + "\n" for line in (FIELDS, *(each.values() for each in rows))))
    return rows


def summary(rows: list[dict[str, str]], like: dict[str, str]) -> str:
    """Returns a sentence with the medians, minima and maxima of the runs of `like`'s processor and options."""
    alike = [row for row in rows if (row["processor"], row["options"]) == (like["processor"], like["options"])]
    days = len({row["time"].split()[0] for row in alike})
    parts = []
    for name, unit in FIGURES.items():
        values = [float(row[name]) for row in alike]
        middle, least, most = (f"{each(values):,.{_digits(name)}f}" for each in (statistics.median, min, max))
        parts.append(f"{middle} {unit} ({least} to {most})")
    runs = f"{len(alike)} run{'s' * (len(alike) > 1)} on {days} day{'s' * (days > 1)}"
    return f"Median of {runs} on this processor, with minimum and maximum: {', '.join(parts)}."


def _digits(name: str) -> int:
    return {"decisions_per_second": 0, "over_c_mujoco_rollout": 3}.get(name, 1)


def _commit() -> str:
    """Returns the commit of this checkout, with a plus if the package has changed since; a dash without git."""
    here = Path(__file__).parents[2]
    try:
        said = subprocess.run(
            ["git", "rev-parse", "--short=8", "HEAD"], cwd=here, capture_output=True, text=True, check=True
        )
        changed = subprocess.run(["git", "diff", "--quiet", "HEAD", "--", "edqn_jax"], cwd=here).returncode
    except (OSError, subprocess.SubprocessError):
        return "-"
    return said.stdout.strip() + "+" * bool(changed)
