"""How well does the drone follow a commanded velocity?

Simulates steps from rest to every action, reversals along the axes, and a hover with `fly_decision`, the function that
training uses. Prints a Markdown table.

    python benchmarks/tracking.py
"""

from __future__ import annotations

from measurement.command import Parser, in_a_sentence

import itertools
import platform
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from edqn_jax.config import Config, DroneConfig
from edqn_jax.sim.physics.airframe import load_airframe
from edqn_jax.sim.physics.drone import DroneState, Flight, hover_state, yaw_of
from edqn_jax.sim.physics.flight import fly_decision
from measurement import json_report

Decide = Callable[[DroneState, jax.Array, jax.Array], tuple[DroneState, Flight]]

SETTLE_DECISIONS = 12
"""Decisions with the first command, before the step."""
RESPONSE_DECISIONS = 12
"""Decisions measured after the step (3.1 s)."""
STEADY_STEPS = 25
"""The steady error is the largest one over this many last physics steps."""


def manoeuvres(speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the commands before and after the step, each [33, 3] m/s: 26 actions from rest, 6 reversals, 1 hover."""
    grid = [c for c in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(c)]
    actions = speed * np.array(sorted(grid, key=lambda c: (np.abs(c).sum(), np.abs(c).tolist())))
    axes = actions[:6]
    before = np.concatenate([np.zeros_like(actions), -axes, np.zeros((1, 3))])
    after = np.concatenate([actions, axes, np.zeros((1, 3))])
    return before, after


def batched_fly(config: DroneConfig) -> Decide:
    """Returns `fly_decision` for a batch of drones, compiled."""
    airframe = load_airframe(config)
    mapped = jax.vmap(fly_decision, (None, None, 0, 0, 0))
    return jax.jit(lambda state, command, yaw: mapped(config, airframe, state, command, yaw))


def measure(config: DroneConfig, speed: float, decide: Decide) -> list[dict[str, Any]]:
    """Simulates every manoeuvre and returns a flat row for each."""
    before, after = manoeuvres(speed)
    batch = len(before)
    yaw = jnp.zeros(batch)
    state = jax.vmap(hover_state)(jnp.zeros((batch, 3)), yaw)
    flights = []
    for decision in range(SETTLE_DECISIONS + RESPONSE_DECISIONS):
        command = before if decision < SETTLE_DECISIONS else after
        state, flight = decide(state, jnp.asarray(command, jnp.float32), yaw)
        flights.append(jax.tree.map(np.asarray, flight))
    position, quaternion, velocity = (
        np.concatenate([getattr(flight, name) for flight in flights], axis=1)
        for name in ("position", "quaternion", "velocity")
    )
    begin = SETTLE_DECISIONS * config.physics_steps - 1
    rows = []
    for i in range(batch):
        kind = "hover" if not after[i].any() else "reversal" if before[i].any() else "from rest"
        name = " ".join(f"{int(v):+d}" if v else "0" for v in after[i])
        row = {"name": f"{kind} to {name}" if kind != "hover" else kind, "kind": kind}
        row |= response(velocity[i, begin:], before[i], after[i], config.physics_dt_s)
        level = before[i, 2] == after[i, 2] == 0
        height = position[i, begin:, 2] - position[i, begin, 2]
        row["height_change_m"] = float(np.abs(height).max()) if level else None
        row["heading_change_deg"] = float(np.degrees(np.abs(yaw_of(jnp.asarray(quaternion[i, begin:]))).max()))
        row["drift_m"] = float(np.linalg.norm(position[i], axis=1).max()) if kind == "hover" else None
        rows.append(row)
    return rows


def response(velocity: np.ndarray, before: np.ndarray, after: np.ndarray, dt: float) -> dict[str, float | None]:
    """Returns step-response figures of velocity [n, 3] m/s, whose first row is from just before the command changed."""
    steady = float(np.linalg.norm(velocity[-STEADY_STEPS:] - after, axis=1).max())
    size = float(np.linalg.norm(after - before))
    if size == 0:
        return {"rise_s": None, "overshoot_percent": None, "steady_error_m_s": steady, "coupling_m_s": None}
    direction = (after - before) / size
    along = (velocity - before) @ direction
    across = velocity - before - along[:, None] * direction
    return {
        "rise_s": dt * (_crossing(along, 0.9 * size) - _crossing(along, 0.1 * size)),
        "overshoot_percent": 100 * max(0.0, float(along.max() / size) - 1),
        "steady_error_m_s": steady,
        "coupling_m_s": float(np.linalg.norm(across, axis=1).max()),
    }


def _crossing(values: np.ndarray, level: float) -> float:
    """Returns the interpolated sample at which `values` first reach `level`; inf if never."""
    reached = np.flatnonzero(values >= level)
    if not len(reached):
        return float("inf")
    i = int(reached[0])
    return i - float((values[i] - level) / (values[i] - values[i - 1])) if i else 0.0


COLUMNS = {
    "rise_s": ("rise 10-90 %, s", "{:.2f}"),
    "overshoot_percent": ("overshoot, %", "{:.1f}"),
    "steady_error_m_s": ("steady error, m/s", "{:.4f}"),
    "coupling_m_s": ("coupling, m/s", "{:.2f}"),
    "height_change_m": ("height change, m", "{:.2f}"),
    "heading_change_deg": ("heading change, deg", "{:.1f}"),
    "drift_m": ("drift, m", "{:.1e}"),
}


def table(rows: list[dict[str, Any]]) -> str:
    """Returns the rows as a Markdown table."""
    lines = ["| manoeuvre, m/s | " + " | ".join(title for title, _ in COLUMNS.values()) + " |"]
    lines.append("| --- |" + " ---: |" * len(COLUMNS))
    for row in rows:
        cells = ["" if row[key] is None else form.format(row[key]) for key, (_, form) in COLUMNS.items()]
        lines.append(f"| {row['name']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, 2 for invalid input."""
    parser = Parser("tracking", __doc__)
    args = parser.parse(argv)
    config = Config()
    rows = measure(config.drone, config.env.speed_m_s, batched_fly(config.drone))
    print(table(rows))
    workload = {
        "physics_steps_per_decision": config.drone.physics_steps,
        "physics_dt": config.drone.physics_dt_s,
        "num_envs": len(rows),
        "physics": config.drone.physics,
    }
    report = {
        "workload": workload,
        "device": f"{jax.devices()[0].device_kind} ({platform.machine()})",
        "versions": {name: version(name) for name in ("jax", "mujoco", "mujoco-mjx")},
        "rows": rows,
    }
    json_report.write(args.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
