"""Are the outcomes right? Replays a run's flights in C MuJoCo, which shares no code with our distances.

Meshes that are not convex, and height fields, are judged by trimesh's distances: MuJoCo takes a mesh for its hull.
Prints for each outcome how many flights the judge confirms: a contact at the stated time for a collision, and no
contact for any other outcome. The exit code is 1 if one outcome differs.

    python benchmarks/verdicts.py RUN --missions 200
"""

from __future__ import annotations

from measurement.command import Parser, in_a_sentence

import platform
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

import jax
import numpy as np

from edqn_jax.evaluation.verdicts import CONTACT_TOLERANCE_M, Agreement, check_verdicts
from edqn_jax.sim.task.outcomes import Outcome
from measurement import json_report
from measurement.recorded import fly_recorded


def rows_of(results: list[Agreement]) -> list[dict[str, Any]]:
    """Returns a row for each outcome that occurs."""
    rows = []
    for outcome in Outcome:
        same = [result for result in results if result.outcome == outcome]
        if not same:
            continue
        apart = [result.apart_m for result in same if result.apart_m is not None]
        rows.append(
            {
                "name": outcome.name.lower(),
                "flights": len(same),
                "judge": " and ".join(sorted({result.judge for result in same})),
                "agree": sum(result.agrees for result in same),
                "contacts_found": sum(result.found is not None for result in same),
                "apart_m_largest": float(np.max(apart)) if apart else None,
            }
        )
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Returns the rows as a Markdown table."""
    lines = [
        "| our outcome | flights | judge | agrees | contacts it finds | largest difference, mm |",
        "| --- | ---: | --- | ---: | ---: | ---: |",
    ]
    for row in rows:
        apart = "" if row["apart_m_largest"] is None else f"{1e3 * row['apart_m_largest']:.3f}"
        lines.append(
            f"| {row['name'].replace('_', ' ')} | {row['flights']} | {row['judge']} | {row['agree']} "
            f"| {row['contacts_found']} | {apart} |"
        )
    return "\n".join(lines)


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 if all outcomes agree, 1 if one differs, 2 for invalid input."""
    parser = Parser("verdicts", __doc__)
    parser.add_flights("folder of a run", missions=200)
    args = parser.parse(argv)
    config, course, flights = fly_recorded(args)
    results = check_verdicts(config, course, flights)
    rows = rows_of(results)
    print(table(rows))
    for result in results:
        if not result.agrees:
            print(f"mission {result.mission}: {result}")
    report = {
        "workload": {
            "physics_steps_per_decision": config.drone.physics_steps,
            "physics_dt": config.drone.physics_dt_s,
            "missions": args.missions,
            "seed": args.seed,
            "world": course.name,
            "contact_tolerance_m": CONTACT_TOLERANCE_M,
            "physics": config.drone.physics,
        },
        "device": f"{jax.devices()[0].device_kind} ({platform.machine()})",
        "versions": {name: version(name) for name in ("jax", "mujoco", "mujoco-mjx")},
        "rows": rows,
    }
    json_report.write(args.json, report)
    return int(not all(result.agrees for result in results))


if __name__ == "__main__":
    sys.exit(main())
