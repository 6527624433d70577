"""Does every fault end a flight as configured, and does none end in a collision that a hover would have avoided?

Missions of one world are flown over the wire, in virtual time; in each of them something goes wrong at a random moment
(`edqn fly --simulate --fault`), and the vehicle is judged for 4 s after the autopilot has left it. A flight that
collides after its fault is flown once more, with the same errors up to that moment, at which a pilot takes over instead
and lets the vehicle stop: what also collides then, no hover would have avoided. Needs the extras `fly`, `export` and
`transfer`.

    python benchmarks/faults.py --world rooms --missions 20 --jobs 2 --seed 33 --json faults.json
    python benchmarks/faults.py --faults "lost link" "low battery" --missions 5
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import dataclasses
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from edqn_jax.fly.faults import Action, Fault
from edqn_jax.fly.simulated.injected import FAULTS, KILLED
from edqn_jax.fly.simulated.missions import Mission, Setup, environment_of, fly_mission
from edqn_jax.fly.simulated.several import fly_at_once
from edqn_jax.interop.deployment.onnx_export import export_policy
from edqn_jax.learn.policy import Policy
from edqn_jax.runs.policies import load_policy
from measurement import json_report

ENDS: dict[str, tuple[tuple[str, ...], str]] = {
    **{str(fault): ((str(fault),), Action.HOLD) for fault in Fault},
    Fault.LOST_LINK: ((Fault.LOST_LINK, Fault.STALE), Action.HOLD),
    Fault.BATTERY: ((Fault.BATTERY,), Action.LAND),
    Fault.TAKEN_OVER: ((Fault.TAKEN_OVER,), "other"),
    KILLED: (("the autopilot was lost",), Action.HOLD),
}
"""How the outcome of a flight with this fault begins, and in which mode the vehicle is left. A link that is lost is
told by its odometry first."""

HEAD = (
    "| fault | struck | ended as configured | collided after it | that a hover avoids | others keep at least |\n"
    "| --- | ---: | ---: | ---: | ---: | ---: |"
)


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments."""
    parser = Parser("faults", __doc__)
    parser.add_argument(
        "run", nargs="?", type=Path, default=Path("pretrained-looks"), help="folder of a run, or a name"
    )
    parser.add_argument("--world", default="rooms", help="random worlds by name, or an MJCF file (default rooms)")
    which = f"of {', '.join(FAULTS)} (default all)"
    parser.add_argument("--faults", nargs="+", default=list(FAULTS), choices=FAULTS, metavar="FAULT", help=which)
    parser.add_argument("--missions", type=at_least_one, default=20, help="with each fault (default 20)")
    parser.add_argument("--jobs", type=at_least_one, default=1, help="flown at once (default 1)")
    parser.add_argument(
        "--camera", nargs=2, type=at_least_one, default=[346, 260], metavar=("W", "H"), help="its pixels"
    )
    parser.add_argument("--seed", type=int, default=33, help="of the test worlds (default 33)")
    return parser.parse(argv)


def struck(fault: str, mission: Mission) -> bool:
    """Returns whether the fault came before the flight had ended."""
    # A fence may be left by the estimate alone, or earlier than by the true place.
    return mission.fault_s is not None or (fault == Fault.FENCE and mission.outcome == fault)


def ended_as_configured(fault: str, mission: Mission) -> bool:
    """Returns whether a flight ended by its fault, and left the vehicle in the mode that is its answer."""
    begins, mode = ENDS[fault]
    return mission.outcome.startswith(begins) and mission.mode == mode


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Returns the report that `--json` writes, and prints a row for each fault."""
    policy = load_policy(args.run)
    print(HEAD, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        file = export_policy(policy, Path(folder) / "policy.onnx").file
        rows = [measure_fault(policy, file, fault, args) for fault in args.faults]
    about = {"world": args.world, "seed": args.seed, "camera": args.camera}
    return {**json_report.machine(jax.devices()), **about, "rows": rows}


def stopped_at(setup: Setup, moment_s: float | None) -> Setup:
    """Returns a setup in which a pilot takes over at a moment, simulated seconds, and nothing else goes wrong."""
    assert moment_s is not None, "a flight that collides after its fault has had one"
    return dataclasses.replace(setup, fault=Fault.TAKEN_OVER, fault_s=(moment_s, moment_s))


def measure_fault(policy: Policy, file: Path, fault: str, args: argparse.Namespace) -> dict[str, Any]:
    """Returns how the flights with a fault ended, and prints their row."""
    setup, asked = (
        Setup(file, (args.camera[0], args.camera[1]), fault=fault),
        (args.world, policy.config, args.missions, args.seed),
    )
    flown = sorted(fly_at_once(*asked, setup, jobs=args.jobs), key=lambda each: each.number)
    came = [each for each in flown if struck(fault, each)]
    hit = [each for each in came if each.outcome == "collision"]
    twins = []
    if hit and fault != Fault.TAKEN_OVER:
        environment = environment_of(*asked)
        twins = [fly_mission(environment, each.number, stopped_at(setup, each.fault_s)) for each in hit]
    avoidable = sum(twin.outcome != "collision" for twin in twins)
    right = sum(ended_as_configured(fault, each) for each in came)
    clear = [each.clearance_after_m for each in came if each.clearance_after_m is not None and each not in hit]
    least = f"{min(clear):.2f} m" if clear else "–"
    print(f"| `{fault}` | {len(came)} of {len(flown)} | {right} | {len(hit)} | {avoidable} | {least} |", flush=True)
    return {
        "fault": fault,
        "missions": [dataclasses.asdict(each) for each in flown],
        "stopped_by_a_pilot": [dataclasses.asdict(each) for each in twins],
        "struck": len(came),
        "as_configured": right,
        "avoidable_collisions": avoidable,
    }


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0, or 2 for invalid input."""
    args = parse(argv)
    json_report.write(args.json, measure(args))
    return 0


if __name__ == "__main__":
    sys.exit(main())
