"""Prints who learns the axis `age` of `benchmarks/worth.py` best, from rows that it wrote, as Markdown.

    python scripts/learners.py docs/results/worth_learners docs/results/worth

The first folder has a folder of rows for each learner (`dqn`, `pqn`, `imitation`, `teacher`), all of events; the second
the rows of the map itself, whose events by DQN are a second training of the same seeds, pooled with those of `dqn`, and
whose blind agent stands beside them. In the second table are sensors that were taught by one policy (folders `taught`,
`taught_teacher`), beside the rows of the map, where they learn by DQN. In the third are events and frames of one more
teacher (folder `one_teacher`). Cells of two times to impact are pooled. Intervals are a bootstrap over seeds and
missions.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

import numpy as np

import success
from worth_parts import own, table
from worth_parts.axes import AXES, SPEEDS_M_S

TIMES = {"0.3 to 0.5 s": ("0.3 to 0.4 s", "0.4 to 0.5 s"), "0.5 to 1 s": ("0.5 to 0.7 s", "0.7 to 1 s")}
COLUMNS = {"blind": "blind", "pqn": "PQN", "dqn": "DQN, two trainings", "imitation": "imitation", "teacher": "teacher"}


TAUGHT = {"frames": "one frame", "frame-pair": "pair", "frame-pair@120": "pair, 120 a second"}
ONE_TEACHER = {"depth": "teacher", "events": "events", "frames": "one frame"}


def arrived(rows: list[success.Row], cells: list[str]) -> np.ndarray:
    """Returns [S, M] which missions of these cells arrived, the seeds of several rows one below the other."""
    seeds = [np.concatenate([_digits(row["flown"][cell]) for cell in cells], axis=1) for row in rows]
    return np.concatenate(seeds) == int(table.GOAL)


def _digits(seeds: list[str]) -> np.ndarray:
    return np.array([list(map(int, seed)) for seed in seeds])


def main(learners: Path, others: Path) -> None:
    """Prints the three tables of the rows in two folders."""
    own.register()
    of_map = {row["sensor"]: [row] for row in table.rows_of(success.read_rows(others), "age")}
    rows = {name: success.read_rows(learners / name) for name in COLUMNS if name != "blind"}
    rows |= {"blind": of_map["blind"], "dqn": rows["dqn"] + of_map["events"]}
    _print_table(
        rows, COLUMNS, {"imitation ahead of DQN by": ("imitation", "dqn"), "PQN behind DQN by": ("dqn", "pqn")}
    )
    print()
    taught = _by_sensor(learners / "taught", TAUGHT)
    rows = {"teacher": success.read_rows(learners / "taught_teacher"), **taught}
    rows |= {f"{name} by DQN": of_map[name] for name in taught}
    leads = {f"{title} ahead of DQN by": (name, f"{name} by DQN") for name, title in TAUGHT.items()}
    _print_table(rows, {"teacher": "teacher"} | TAUGHT, leads)
    print()
    rows = _by_sensor(learners / "one_teacher", ONE_TEACHER)
    leads = {"events ahead of one frame by": ("events", "frames"), "events behind the teacher by": ("depth", "events")}
    _print_table(rows, ONE_TEACHER, leads)


def _by_sensor(folder: Path, sensors: Iterable[str]) -> dict[str, list[success.Row]]:
    """Returns the rows of a folder in the order of these sensors: a bootstrap draws for one after the other."""
    rows = success.read_rows(folder)
    return {sensor: [row for row in rows if row["sensor"] == sensor] for sensor in sensors}


def _print_table(
    rows: dict[str, list[success.Row]], columns: dict[str, str], leads: dict[str, tuple[str, str]]
) -> None:
    print(f"| m/s | time to impact | {' | '.join([*columns.values(), *leads])} |")
    print("| --- " * (len(columns) + len(leads) + 2) + "|")
    for speed in SPEEDS_M_S:
        for title, times in TIMES.items():
            cells = [cell for cell in AXES["age"].flown if cell.startswith(times) and cell.endswith(f" {speed:g} m/s")]
            cell = table.Cell("court", "", title, {name: arrived(rows[name], cells) for name in rows})
            shown = [f"{100 * cell.arrived[name].mean():.1f} ({_text(cell.interval(name), '–')})" for name in columns]
            shown += [_lead(cell, *pair) for pair in leads.values()]
            print(f"| {speed:g} | {title} | {' | '.join(shown)} |")


def _lead(cell: table.Cell, first: str, second: str) -> str:
    ahead, (low, high) = 100 * (cell.arrived[first].mean() - cell.arrived[second].mean()), cell.lead(first, second)
    bold = "**" if low > 0 or high < 0 else ""
    return f"{bold}{ahead:.1f}{bold} ({_text((low, high), ' to ')})"


def _text(interval: tuple[float, float], to: str) -> str:
    return to.join(f"{100 * end:.1f}" for end in interval)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*map(Path, sys.argv[1:]))
