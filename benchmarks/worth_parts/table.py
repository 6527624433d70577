"""Tables of `worth.py`: success as blind, sensors, true depth, and which of them leads."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import yaml

import success
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.intervals import bootstrap_rates, percentile_interval, rate_interval
from measurement.intervals import difference_interval
from worth_parts import traffic
from worth_parts.axes import AXES, BLIND, CONTROLS, DEPTH, FRAMES, Axis, camera_of, flown_of, is_first_alone

GOAL = "1"
"""Digit of a flight that arrived."""

LATE = "depth-late"
"""Begins the names of true depth that is old."""

ALIKE = {"missions": "missions", "test_seed": "test worlds"}
"""By key of a row, in words: what the rows of an axis have alike, beside their learner; those of a world are of as many
decisions, too."""

DRAWS = 4000
"""Of the bootstrap of a cell, over seeds and missions; the missions of a draw are the same for all of its sensors."""


@dataclasses.dataclass
class Cell:
    """Policies of several sensors in the same missions, trained and flown in one condition each."""

    world: str
    trained: str
    flown: str
    arrived: dict[str, np.ndarray]
    """[S, M] bool by sensor: S seeds, M missions."""
    missing: Sequence[str] = ()
    """Rivals of the axis of which there is no row, so that who leads is said of the others alone."""

    @functools.cached_property
    def drawn(self) -> dict[str, np.ndarray]:
        """Returns rates of success [DRAWS] of bootstrap draws by sensor."""
        return dict(zip(self.arrived, bootstrap_rates(list(self.arrived.values()), DRAWS), strict=True))

    def interval(self, sensor: str) -> tuple[float, float]:
        """Returns the interval of a sensor's success; of 0 and of 1, whose bootstrap does not vary, Wilson's."""
        if 0 < self.arrived[sensor].mean() < 1:
            return percentile_interval(self.drawn[sensor])
        return rate_interval(self.arrived[sensor])

    def lead(self, first: str, second: str) -> tuple[float, float]:
        """Returns the interval of the success of the first sensor minus that of the second, on the same missions."""
        both = [self.arrived[sensor] for sensor in (first, second)]
        if all(0 < each.mean() < 1 for each in both):
            return percentile_interval(self.drawn[first] - self.drawn[second])
        return difference_interval(*both)

    @property
    def rivals(self) -> list[str]:
        """Returns the sensors that are compared: all but the controls; true depth of several ages where no other is."""
        return rivals_of(self.arrived)


def rivals_of(sensors: Iterable[str]) -> list[str]:
    """Returns those of an axis's sensors that are compared; see `Cell.rivals`."""
    known = list(sensors)
    rivals = [sensor for sensor in known if sensor not in CONTROLS]
    if all(sensor.startswith(LATE) for sensor in rivals):
        return [sensor for sensor in known if sensor != BLIND]
    return [sensor for sensor in rivals if not sensor.startswith(LATE)]


def rows_of(rows: Iterable[success.Row], axis: str) -> list[success.Row]:
    """Returns the rows of an axis, of those with the same name the newest; where it has rows, with those it borrows.

    Raises:
        ConfigError: if they were not trained and flown alike.
    """
    newest, borrowed = {}, AXES[axis].borrowed if axis in AXES else {}
    known = [row for row in rows if row.get("benchmark") == "worth"]
    own = [row for row in known if row["axis"] == axis]
    if own:
        own += [row for row in known if row["axis"] == borrowed.get(row.get("sensor", ""))]
    for row in own:
        newest[tuple(row.get(key) for key in ("world", "trained", "sensor", "width", "look"))] = row
    found = list(newest.values())
    alike = {said: {row.get(key) for row in found} for key, said in ALIKE.items()}
    alike["learners"] = {_learner(row) for row in found}
    for said, values in alike.items():
        if len(values) > 1:
            raise ConfigError(f"the rows of the axis {axis} have other {said} than each other; move some of them away")
    for world, lengths in _decisions(found).items():
        if len(lengths) > 1:
            raise ConfigError(
                f"the rows of the axis {axis} in {world} have other decisions than each other; move some of them away"
            )
    return found


def _decisions(rows: Iterable[success.Row]) -> dict[str, set[int | None]]:
    """Returns by world for how many decisions a seed was trained; rows of bytes were not."""
    found: dict[str, set[int | None]] = {}
    for row in rows:
        found.setdefault(row["world"], set()).add(row.get("decisions"))
    return found


def _learner(row: success.Row) -> str | None:
    """Returns the learner of a row of flights; those of bytes have none."""
    return yaml.safe_load(row["options"])["agent"]["learner"] if "options" in row else None


def cells_of(rows: Sequence[success.Row], axis: Axis) -> list[Cell]:
    """Returns the cells of an axis of which there are rows, in its order; a control that is alike stands in each."""
    of = {(row["world"], row["trained"], row["sensor"]): row for row in rows}
    first, cells = next(iter(axis.trained)), []
    for world, trained, flown in itertools.product(axis.worlds, axis.trained, axis.flown):
        arrived = {}
        for sensor in axis.shown:
            row = of.get((world, first if is_first_alone(axis, sensor) else trained, sensor))
            if row is None:
                continue
            alike = next(iter(axis.flown)) if len(flown_of(axis, sensor)) == 1 else flown
            if alike in row["flown"]:
                arrived[sensor] = np.array([[digit == GOAL for digit in seed] for seed in row["flown"][alike]])
        own = arrived.keys() & axis.sensors.keys()
        if own - set(CONTROLS) or len(own) == len(axis.sensors):
            missing = [sensor for sensor in rivals_of(axis.shown) if sensor not in arrived]
            cells.append(Cell(world, trained, flown, arrived, missing))
    return cells


def best_of(cell: Cell) -> list[str]:
    """Returns the rival with the most success, and after it those from which its interval of difference holds 0."""
    rivals = sorted(cell.rivals, key=lambda sensor: -cell.arrived[sensor].mean())
    return [*rivals[:1], *(sensor for sensor in rivals[1:] if cell.lead(rivals[0], sensor)[0] <= 0)]


def verdict_of(best: Sequence[str], rivals: Sequence[str]) -> str:
    """Returns who leads, in words: a sensor; `frames or pairs` where only events are behind; or `no difference`."""
    if len(rivals) < 2:
        return "–"
    if len(best) == 1:
        return best[0]
    if _are_frames(best) and not _are_frames(rivals):
        return "frames or pairs"
    return "no difference"


def _are_frames(sensors: Iterable[str]) -> bool:
    return all(camera_of(sensor) in FRAMES for sensor in sensors)


def all_cells(rows: Sequence[success.Row]) -> dict[str, list[Cell]]:
    """Returns the cells of each axis that has some.

    Raises:
        ConfigError: if rows of an axis were not measured alike.
    """
    return {name: found for name, axis in AXES.items() if (found := cells_of(rows_of(rows, name), axis))}


def tables(rows: Sequence[success.Row], cells: Mapping[str, Sequence[Cell]]) -> str:
    """Returns the rows as Markdown, a table for each axis of which there are some.

    Args:
        rows: all.
        cells: of `all_cells`.

    Raises:
        ConfigError: if rows of an axis were not measured alike.
    """
    shown = [_flights_table(name, rows_of(rows, name), found) for name, found in cells.items()]
    if counted := rows_of(rows, "bytes"):
        shown.append(_bytes_table(counted))
    return "\n\n".join(shown) if shown else "There are no rows."


def _flights_table(name: str, rows: Sequence[success.Row], cells: Sequence[Cell]) -> str:
    axis = AXES[name]
    sensors = [sensor for sensor in axis.shown if sensor not in CONTROLS]
    columns = [sensor for sensor in (BLIND, *sensors, DEPTH) if any(sensor in cell.arrived for cell in cells)]
    first, seeds = rows[0], sorted({len(row["seeds"]) for row in rows})
    worlds = first["test_seed"] * first["missions"]
    lines = [
        f"{axis.question}: {' or '.join(map(str, seeds))} seeds × {first['missions']:,} missions a cell, the same for "
        f"all sensors (test worlds {worlds} to {worlds + first['missions'] - 1}), {_budgets(rows)} decisions a "
        "seed. Success in % with its 95 % interval; who leads of all but the controls; and by how many points events "
        "are ahead of that sensor of frames which does best in the cell.",
        "",
        f"| world | trained | flown | {' | '.join(columns)} | leads | events ahead by |",
        f"| --- | --- | --- |{' --- |' * len(columns)} --- | --- |",
    ]
    for cell in cells:
        shown = " | ".join(_rate(cell, sensor) for sensor in columns)
        leads = verdict_of(best_of(cell), cell.rivals)
        if cell.missing:
            leads += f" (not flown: {', '.join(cell.missing)})"
        lines.append(f"| {cell.world} | {cell.trained} | {cell.flown} | {shown} | {leads} | {_ahead(cell)} |")
    return "\n".join(lines)


def _budgets(rows: Sequence[success.Row]) -> str:
    """Returns the decisions of a seed, by world where worlds differ."""
    budgets = {world: f"{count:,}" for world, (count,) in _decisions(rows).items()}
    if len(set(budgets.values())) == 1:
        return next(iter(budgets.values()))
    return ", ".join(f"in {world} {count}" for world, count in budgets.items())


def _rate(cell: Cell, sensor: str) -> str:
    if sensor not in cell.arrived:
        return "–"
    low, high = cell.interval(sensor)
    return f"{100 * cell.arrived[sensor].mean():.1f} ({100 * low:.1f} to {100 * high:.1f})"


def _ahead(cell: Cell) -> str:
    """Returns by how many points events are ahead of the best sensor of frames, with the interval."""
    frames = [sensor for sensor in cell.arrived if camera_of(sensor) in FRAMES]
    if not frames or "events" not in cell.arrived:
        return "–"
    best = max(frames, key=lambda sensor: cell.arrived[sensor].mean())
    low, high = cell.lead("events", best)
    ahead = cell.arrived["events"].mean() - cell.arrived[best].mean()
    return f"{100 * ahead:.1f} ({100 * low:.1f} to {100 * high:.1f})"


def _bytes_table(rows: Sequence[success.Row]) -> str:
    first = rows[0]
    heads, worlds = [f"{size} bytes an event" for size in traffic.EVENT_BYTES], first["test_seed"] * first["missions"]
    lines = [
        f"Bytes: the policy {first['policy']} in {first['missions']} test worlds each, from {worlds} on, "
        f"{traffic.MOMENTS} moments of 0.2 s a flight, an ESIM sensor without noise. The break-even is the frame rate "
        "at which 8-bit frames cost as many bytes a second, with its 95 % interval over flights: slower frames cost "
        "less than events.",
        "",
        f"| world | look | pixels | contrast | events a second | {' | '.join(f'break-even, {x}' for x in heads)} |",
        f"| --- | --- | --- | ---: | ---: |{' ---: |' * len(heads)}",
    ]
    for row in sorted(rows, key=lambda row: (traffic.WORLDS.index(row["world"]), row["width"])):
        for contrast, rates in row["events_per_second"].items():
            found = [traffic.break_even(row, contrast, size) for size in traffic.EVENT_BYTES]
            shown = " | ".join(f"{rate:.1f} Hz ({low:.1f} to {high:.1f})" for rate, low, high in found)
            lines.append(
                f"| {row['world']} | {row['look']} | {row['width']} × {row['height']} | {contrast} "
                f"| {np.mean(rates):,.0f} | {shown} |"
            )
    return "\n".join(lines)
