"""Table 3 measured: E-DQN beside everything that a user might pick instead, on the same worlds in the same run.

Three times are kept apart: training (to a policy that flies), planning (computation from start to goal; simulation
and compilation are not counted) and flight (simulated seconds). Each method is a process of its own that compiles
once; they take turns, seed by seed, so that a slow minute hits all alike.

    python benchmarks/runtime.py --json runtime.json --figure runtime.png
    python benchmarks/runtime.py --quick
    python benchmarks/runtime.py --worlds medium --methods E-DQN "DQN blind" --seeds 2 -- --total-steps 1000000
    python benchmarks/runtime.py --seeds 0 --add cpu.json gpu.json --figure both.png

What stands after -- goes to the learners' configuration as it would for train.py. The full run, five seeds on both
worlds, takes about five hours on two cores, nearly all of it training on medium worlds; --quick less than ten minutes.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax

import json_report
import runtime_table
from child import Child, ChildEndedError
from edqn_jax.baselines.astar import NoPathError, shortest_path
from edqn_jax.baselines.planner import PLANNERS
from edqn_jax.cli import parse_train
from edqn_jax.config import DENSITIES, Config, ConfigError
from edqn_jax.devices import cores
from edqn_jax.files import check_can_write
from edqn_jax.resolve import nearest, to_yaml
from edqn_jax.sim.scene import Scene
from flags import split
from learners import LEARNERS, sensing
from planning import judged_scenes
from rows import Row, joined
from runtime_figure import draw_runtime

ROOT = Path(__file__).resolve().parents[1]
WORLDS = ("paper", "medium")
METHODS = (*LEARNERS, *PLANNERS)
SEEDS, QUICK_SEEDS = 5, 2
POINTS = 20
"""Validations of a training, unless the flags say otherwise: points of the learning curve."""
BUDGET_SECONDS, QUICK_BUDGET_SECONDS = 5.0, 1.0
PLANNED, QUICK_PLANNED = 32, 8
"""Missions that planners are given in random worlds, the first of those that learners are judged by."""

QUICK = (
    *("--total-steps", "60000", "--train.validation-missions", "32", "--train.validation-every", "15000"),
    *("--world.pool-size", "128", "--world.missions", "1024"),
)
"""Flags of `--quick`: long enough to run every part, too short to learn; and fewer worlds, which take time to draw."""

GUESS = 6_000.0
"""Decisions/s of two cores, for the length that is told before anything is measured."""


@dataclasses.dataclass
class Asked:
    """The arguments, checked."""

    words: argparse.Namespace
    configs: dict[str, Config]
    """By world, as E-DQN's."""
    added: list[dict[str, Any]]
    """Reports of earlier runs."""

    @property
    def budget(self) -> float:
        return self.words.budget

    @property
    def settings(self) -> dict[str, Any]:
        return {"quick": self.words.quick}


def parse(argv: Sequence[str] | None = None) -> Asked:
    """The arguments.

    Raises:
        ConfigError: if a method or a world is unknown, the flags cannot be run, or a file cannot be read or written.
    """
    words, flags = split(sys.argv[1:] if argv is None else argv)
    parser = argparse.ArgumentParser(
        prog="python benchmarks/runtime.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="60 000 decisions, two seeds: nothing converges")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), metavar="NAME", help=f"of {', '.join(METHODS)}")
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), metavar="WORLD", help="as --world of train.py")
    parser.add_argument("--seeds", type=int, help=f"how many (default {SEEDS}, quick {QUICK_SEEDS}); 0 runs nothing")
    parser.add_argument("--first-seed", type=int, default=0, metavar="SEED")
    parser.add_argument(
        "--budget", type=float, metavar="SECONDS", help=f"of a plan (default {BUDGET_SECONDS}, quick "
        f"{QUICK_BUDGET_SECONDS}); only RRT* and BIT* use it up",
    )  # fmt: skip
    parser.add_argument("--add", nargs="+", type=Path, default=[], metavar="FILE.json", help="rows of earlier runs")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--figure", type=Path, metavar="FILE.png", help="draw the rows")
    args = parser.parse_args(words)
    if args.seeds is None:
        args.seeds = QUICK_SEEDS if args.quick else SEEDS
    if args.budget is None:
        args.budget = QUICK_BUDGET_SECONDS if args.quick else BUDGET_SECONDS
    for name in args.methods:
        if name not in METHODS:
            raise ConfigError(f"there is no method '{name}'{nearest(name, METHODS)}")
    for name in ("seeds", "first_seed"):
        if getattr(args, name) < 0:
            raise ConfigError(f"--{name.replace('_', '-')} must be at least 0, not {getattr(args, name)}")
    if not args.budget > 0:
        raise ConfigError(f"--budget must be more than 0 seconds, not {args.budget:g}")
    for file in (args.json, args.figure):
        if file is not None:
            check_can_write(file)
    added = [read(file) for file in args.add]
    configs = {world: configured(world, flags, args.quick) for world in (args.worlds if args.seeds else [])}
    return Asked(args, configs, added)


def configured(world: str, flags: Sequence[str], quick: bool) -> Config:
    """What `train.py` would run on that world, validated `POINTS` times.

    Raises:
        ConfigError: if it cannot be run.
    """
    _, config = parse_train(["--world", world, *(QUICK if quick else ()), *flags])
    if not quick and not any(flag.replace("_", "-").startswith("--train.validation-every") for flag in flags):
        every = -(-config.train.total_steps // POINTS)
        config = dataclasses.replace(config, train=dataclasses.replace(config.train, validation_every=every))
    judged_scenes(config, 1)  # or a sentence
    return config


def read(file: Path) -> dict[str, Any]:
    """The report of an earlier run.

    Raises:
        ConfigError: if it is none.
    """
    try:
        report = json.loads(file.read_text(encoding="utf-8"))
        if report["benchmark"] == "runtime":
            return report
    except OSError as error:
        raise ConfigError(f"'{file}' cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        pass
    raise ConfigError(f"'{file}' holds no rows of this benchmark")


# ------------------------------------------------------------------------------------------ running


def shortest_of(config: Config, scenes: Sequence[Scene]) -> list[float | None]:
    """Length of A*'s path in each world, metres; None where there is none."""

    def length(scene: Scene) -> float | None:
        try:
            return shortest_path(scene, scene.start, scene.goal, config.drone.body_radius_m).length_m
        except NoPathError:
            return None

    return [length(scene) for scene in scenes]


@contextlib.contextmanager
def started(asked: Asked, world: str, has_way: bool) -> Iterator[tuple[list[Row], dict[str, Child]]]:
    """A row for each method, and the child of each that can run; as many compile at once as there are cores."""
    count = missions_of(asked, world)
    rows = [
        {
            "name": name,
            "world": Path(world).name,
            "kind": "planner" if name in PLANNERS else "learner",
            "knows_map": name in PLANNERS,
            "settings": {
                **asked.settings,
                **({"budget_seconds": asked.budget} if name in PLANNERS else {}),
            },
            "reason": None,
            "turns": [],
        }
        for name in asked.words.methods
    ]
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        children: dict[str, Child] = {}
        waiting: list[Row] = []

        def settle(row: Row) -> None:
            try:
                about = children[row["name"]].answer()
                row |= about
            except ChildEndedError as error:
                row["reason"] = f"it ended: {error}"
            if row["reason"] is not None:
                del children[row["name"]]

        for number, row in enumerate(rows):
            row |= {"device": None, "devices": [], "versions": {}, "workload": {}}
            try:
                if row["kind"] == "learner" and not has_way:
                    raise ConfigError("there is no way from start to goal, so train.py refuses this world")
                config = (
                    asked.configs[world] if row["kind"] == "planner" else sensing(asked.configs[world], row["name"])
                )
            except ConfigError as error:
                row["reason"] = str(error)
                continue
            if row["kind"] == "learner":
                row["settings"] |= {"decisions": config.train.total_steps, "num_envs": config.train.num_envs}
            file = folder / f"{number}.yaml"
            file.write_text(to_yaml(config), encoding="utf-8")
            words = [row["name"], str(file), str(asked.budget), str(count)]
            child = Child(ROOT, ROOT / "benchmarks" / "rival.py", words, folder / f"{number}.log")
            children[row["name"]] = stack.enter_context(child)
            waiting.append(row)
            if len(waiting) >= cores():
                settle(waiting.pop(0))
        for row in waiting:
            settle(row)
        yield rows, children


def missions_of(asked: Asked, world: str) -> int:
    """How many missions planners are given."""
    if world not in DENSITIES:
        return 1
    most = asked.configs[world].train.validation_missions
    return min(most, QUICK_PLANNED if asked.words.quick else PLANNED)


def measure(asked: Asked) -> list[Row]:
    """The rows, method by method, world by world."""
    rows: list[Row] = []
    args, clock = asked.words, time.perf_counter()
    for world, config in asked.configs.items():
        tell(f"{world}: {expected(asked, world)}")
        scenes = judged_scenes(config, config.train.validation_missions)
        shortest = shortest_of(config, scenes)
        with started(asked, world, shortest[0] is not None) as (new, children):
            rows += new
            ready = time.perf_counter()
            for seed in range(args.first_seed, args.first_seed + args.seeds):
                for row in new:
                    if row["name"] not in children:
                        continue
                    try:
                        turn = children[row["name"]].ask(str(seed))
                    except ChildEndedError as error:
                        row["reason"] = f"it ended in seed {seed}: {error}"
                        del children[row["name"]]
                        continue
                    flown = turn["flights"]
                    flown["shortest_m"] = shortest[: len(flown["outcome"])]
                    row["turns"].append(turn)
                done = seed - args.first_seed + 1
                left = (time.perf_counter() - ready) / done * (args.seeds - done)
                tell(f"{world}: seed {seed} done after {time.perf_counter() - clock:.0f} s, {left / 60:.0f} min to go")
    return rows


def expected(asked: Asked, world: str) -> str:
    """How long it will be, before anything is measured."""
    args = asked.words
    learners = [name for name in args.methods if name in LEARNERS]
    drawing = [name for name in args.methods if name in ("RRT*", "BIT*")]
    decisions = args.seeds * len(learners) * asked.configs[world].train.total_steps
    planning = args.seeds * len(drawing) * missions_of(asked, world) * asked.budget
    return (
        f"{decisions:,} decisions to train and {planning:.0f} s to plan, "
        f"about {(decisions / GUESS + planning) / 60 + len(learners):.0f} min at {GUESS:,.0f} decisions/s"
    )


def tell(text: str) -> None:
    """Progress, which is no part of the table."""
    print(text, file=sys.stderr, flush=True)


def report_of(rows: Sequence[Row]) -> dict[str, Any]:
    """What `--json` holds."""
    ran = next((row for row in rows if row["turns"]), None)
    return {
        "benchmark": "runtime",
        "workload": ran["workload"] if ran else {},
        "device": ran["device"] if ran else None,
        "devices": ran["devices"] if ran else [],
        "versions": ran["versions"] if ran else {},
        "rows": [{**row, **runtime_table.figures(row)} for row in rows],
        "worth": [dataclasses.asdict(one) for one in runtime_table.worth(rows)],
        "paper": {"source": runtime_table.PAPER_SOURCE, "run_time_s": runtime_table.PAPER_RUN_TIME_S},
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code 0 when all was measured, whatever came out; 2 for bad input."""
    jax.config.update("jax_platforms", "cpu")  # the children's is the accelerator, if there is one
    try:
        asked = parse(argv)
        rows = joined([*measure(asked), *(row for report in asked.added for row in report["rows"])])
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    print(runtime_table.text(rows))
    if asked.words.json is not None:
        json_report.write(asked.words.json, report_of(rows))
    if asked.words.figure is not None:
        draw_runtime(rows, asked.words.figure)
    return 0


if __name__ == "__main__":
    sys.exit(main())
