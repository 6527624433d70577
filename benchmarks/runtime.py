"""Compares E-DQN with other learners and with planners, as Table 3 of the paper, on the same worlds in the same run.

Three times are measured: training (until the policy succeeds), planning (computation from start to goal, without
simulation and compilation) and flight (simulated seconds). Each method runs in a process of its own that compiles once.
The methods take turns, seed by seed, so that a change in the machine's speed affects all of them.

    python benchmarks/runtime.py --json runtime.json --figure runtime.png
    python benchmarks/runtime.py --quick
    python benchmarks/runtime.py --worlds medium --methods E-DQN "DQN blind" --seeds 2 -- --total-steps 1000000
    python benchmarks/runtime.py --seeds 0 --add cpu.json gpu.json --figure both.png

Arguments after -- are options of train.py for the learners. The full run, five seeds on both worlds, takes about three
and a quarter hours on two cores: one for the paper's world, the rest for medium worlds. All methods of a world are kept
in memory, about 15 GB. --quick is one seed of E-DQN and the blind agent on the paper's world, beside all planners.
"""

from __future__ import annotations

from measurement.command import Parser, in_a_sentence

import argparse
import contextlib
import dataclasses
import hashlib
import json
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from conventional_stack.settings import DRONES, supported_config
from edqn_jax.config import FAMILIES, Config
from edqn_jax.config.loading import suggest_nearest, to_yaml
from edqn_jax.devices.hardware import count_cores
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.metrics import format_duration
from measurement import json_report
from measurement.child import Child, ChildEndedError
from measurement.flags import parse_config as for_timing
from measurement.flags import parse_options, split, with_test_worlds_only
from measurement.whole import steady
from rivals import table
from rivals.figure import draw_runtime
from rivals.learners import LEARNERS, sensing
from rivals.planners.planner import IMPROVING, PLANNERS
from rivals.planning import judged_scenes, keep_to_cpu, shortest_lengths
from rivals.rows import Row, figures, join_rows, worth
from rivals.stack import STACK, STEADY

ROOT = Path(__file__).resolve().parents[1]
WORLDS, QUICK_WORLDS = ("paper", "medium"), ("paper",)
METHODS = (*LEARNERS, *PLANNERS, STACK)
QUICK_METHODS = ("E-DQN", "DQN blind", *PLANNERS)
SEEDS, QUICK_SEEDS = 5, 1
POINTS = 20
"""Number of validations in a training, the points of the learning curve, unless --train.validation-every is given."""
BUDGET_SECONDS, QUICK_BUDGET_SECONDS = 5.0, 1.0
PLANNED, QUICK_PLANNED = 32, 4
"""Number of missions for planners in random worlds, the first of the test missions of learners."""
QUICK = (
    *("--total-steps", "500000", "--train.validation-missions", "32", "--train.validation-every", "50000"),
    *("--world.pool-size", "128", "--world.missions", "1024"),
)
"""Options for `--quick`: enough decisions to learn the paper's world, fewer validations and worlds to generate."""

TURNS, QUICK_TURNS = 5, 1
"""Turns of the training rates."""

GUESS, STACK_GUESS = 6_000.0, 2_500.0
"""Assumed decisions/s on two cores of learners and of the conventional stack, to estimate the duration."""


@dataclasses.dataclass
class Asked:
    """The checked arguments."""

    words: argparse.Namespace
    configs: dict[str, Config]
    """Configuration of E-DQN by world."""
    flags: list[str]
    """Arguments after --."""
    added: list[dict[str, Any]]
    """Reports of earlier runs."""


def parse(argv: Sequence[str] | None = None) -> Asked:
    """Parses and checks the arguments.

    Raises:
        ConfigError: if a method or world is unknown, options are invalid, or a file cannot be read or written.
    """
    words, flags = split(argv)
    parser = Parser("runtime", __doc__)
    parser.add_argument(
        "--quick", action="store_true", help="E-DQN, the blind agent and all planners on the paper's world, one seed"
    )
    parser.add_argument(
        "--methods",
        nargs="+",
        metavar="NAME",
        help=f"methods to run (default: all, quick without the other learners): {', '.join(METHODS)}",
    )
    parser.add_argument(
        "--worlds", nargs="+", metavar="WORLD", help="--world of train.py (default paper and medium, quick paper)"
    )
    parser.add_argument(
        "--seeds", type=int, help=f"number of seeds (default {SEEDS}, quick {QUICK_SEEDS}); 0 runs nothing"
    )
    parser.add_argument("--first-seed", type=int, default=0, metavar="SEED", help="the first seed (default 0)")
    parser.add_argument(
        "--budget", type=float, metavar="SECONDS", help=f"time for one plan (default {BUDGET_SECONDS}, quick "
        f"{QUICK_BUDGET_SECONDS}); only RRT* and BIT* always use it",
    )  # fmt: skip
    parser.add_argument(
        "--add", nargs="+", type=Path, default=[], metavar="FILE.json", help="add the rows of earlier reports"
    )
    parser.add_argument("--figure", type=Path, metavar="FILE.png", help="write a picture of the rows to this file")
    args = parser.parse(words)
    if args.methods is None:
        args.methods = list(QUICK_METHODS if args.quick else METHODS)
    if args.worlds is None:
        args.worlds = list(QUICK_WORLDS if args.quick else WORLDS)
    if args.seeds is None:
        args.seeds = QUICK_SEEDS if args.quick else SEEDS
    if args.budget is None:
        args.budget = QUICK_BUDGET_SECONDS if args.quick else BUDGET_SECONDS
    for name in args.methods:
        if name not in METHODS:
            raise ConfigError(f"there is no method '{name}'{suggest_nearest(name, METHODS)}")
    for name in ("seeds", "first_seed"):
        if getattr(args, name) < 0:
            raise ConfigError(f"--{name.replace('_', '-')} must be at least 0, not {getattr(args, name)}")
    if not 0 < args.budget < math.inf:
        raise ConfigError(f"--budget must be a finite number of seconds, more than 0, not {args.budget:g}")
    check_worlds(args.worlds)
    if args.figure is not None and args.figure.suffix != ".png":
        raise ConfigError(f"--figure must end in .png, not '{args.figure}'")
    added = [read(file) for file in args.add]
    join_rows(row for report in added for row in report["rows"])  # raises before anything is measured
    configs = {world: config_for_world(world, flags, args.quick) for world in (args.worlds if args.seeds else [])}
    return Asked(args, configs, flags, added)


def check_worlds(worlds: Sequence[str]) -> None:
    """Raises ConfigError where two worlds would have rows of the same name."""
    named: dict[str, str] = {}
    for world in worlds:
        other = named.setdefault(Path(world).name, world)
        if other != world:
            raise ConfigError(f"'{other}' and '{world}' would have rows of the same name; rename one of the files")


def config_for_world(world: str, flags: Sequence[str], quick: bool) -> Config:
    """Returns the configuration of `train.py` for that world, with `POINTS` validations and test missions alone.

    Raises:
        ConfigError: if it is invalid.
    """
    config = with_test_worlds_only(parse_options(["--world", world, *(QUICK if quick else ()), *flags]))
    if not quick and not any(flag.replace("_", "-").startswith("--train.validation-every") for flag in flags):
        every = -(-config.train.total_steps // POINTS)
        config = dataclasses.replace(config, train=dataclasses.replace(config.train, validation_every=every))
    judged_scenes(config, 1)  # raises if the world cannot be used
    return config


def read(file: Path) -> dict[str, Any]:
    """Returns the report of an earlier run.

    Raises:
        ConfigError: if the file is not a report of this benchmark.
    """
    try:
        report = json.loads(file.read_text(encoding="utf-8"))
        if report["benchmark"] == "runtime" and all(isinstance(report[part], list) for part in ("rows", "rates")):
            return report
    except OSError as error:
        raise ConfigError(f"'{file}' cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        pass
    raise ConfigError(f"'{file}' is not a report of this benchmark")


# ------------------------------------------------------------------------------------------ running


def launch_children(
    stack: contextlib.ExitStack, wanted: dict[str, Config], budget: float = 0.0, count: int = 0
) -> tuple[dict[str, Child], dict[str, dict[str, Any]]]:
    """Starts a child for each method and waits until they are ready; as many start at once as there are cores.

    Args:
        stack: ends the children when it is closed.
        wanted: configuration by method.
        budget: seconds for one plan.
        count: number of missions of a planner.

    Returns:
        the children that can run; the description of each method, or `reason`, why it cannot run.
    """
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    children: dict[str, Child] = {}
    said: dict[str, dict[str, Any]] = {}
    waiting: list[str] = []

    def settle(name: str) -> None:
        try:
            said[name] = children[name].answer()
        except ChildEndedError as error:
            said[name] = {"reason": f"its process ended: {error}"}
        if "reason" in said[name]:
            del children[name]

    for number, (name, config) in enumerate(wanted.items()):
        file = folder / f"{number}.yaml"
        file.write_text(to_yaml(config), encoding="utf-8")
        words = [name, str(file), str(budget), str(count)]
        child = Child(ROOT, ROOT / "benchmarks" / "rivals" / "rival.py", words, folder / f"{number}.log")
        children[name] = stack.enter_context(child)
        waiting.append(name)
        if len(waiting) >= count_cores():
            settle(waiting.pop(0))
    for name in waiting:
        settle(name)
    return children, said


def blank(asked: Asked, world: str, name: str) -> Row:
    """Returns the row of a method before it has run."""
    planner, config = name in PLANNERS, asked.configs[world]
    own = (
        {"budget_seconds": asked.words.budget, "missions": missions_of(asked, world)}
        if planner
        else {"decisions": config.train.total_steps, "num_envs": config.train.num_envs}
    )
    # Rows with other options must not be joined with this one. A planner has no agent, camera or encoder.
    of_flight = dataclasses.replace(Config(), world=config.world, drone=config.drone, env=config.env)
    options = hashlib.sha256(to_yaml(of_flight if planner else config).encode()).hexdigest()[:16]
    return {
        "name": name,
        "world": Path(world).name,
        "kind": "planner" if planner else "learner",
        "knows_map": planner,
        "settings": {"quick": asked.words.quick, **own, "options": options},
        "device": None,
        "devices": [],
        "versions": {},
        "workload": {},
        "reason": None,
        "turns": [],
    }


def config_of(asked: Asked, world: str, name: str, has_path: bool) -> Config:
    """Returns the configuration of a method on a world.

    Raises:
        ConfigError: if the method cannot run there.
    """
    config = asked.configs[world]
    if name in PLANNERS:
        return config
    if not has_path:
        raise ConfigError("there is no path from start to goal, so train.py rejects this world")
    return supported_config(config) if name == STACK else sensing(config, name)


def missions_of(asked: Asked, world: str) -> int:
    """Returns the number of missions for planners."""
    if world not in FAMILIES:
        return 1
    most = asked.configs[world].train.validation_missions
    return min(most, QUICK_PLANNED if asked.words.quick else PLANNED)


def measure(asked: Asked) -> list[Row]:
    """Measures and returns the rows of all worlds, one world after the other.

    The report is written after each seed, because a full run takes hours.
    """
    rows: list[Row] = []
    for world in asked.configs:
        new: list[Row] = []
        for new in measure_world(asked, world):
            if asked.words.json is not None:
                json_report.write_row(asked.words.json, report_of([*rows, *new], []))
        rows += new
    return rows


def measure_world(asked: Asked, world: str) -> Iterator[list[Row]]:
    """Yields the rows of one world after each seed; the methods take turns, seed by seed."""
    args, config = asked.words, asked.configs[world]
    tell(f"{world}: {expected(asked, world)}")
    shortest = shortest_lengths(config, judged_scenes(config, config.train.validation_missions))
    rows, wanted = {name: blank(asked, world, name) for name in args.methods}, {}
    for name, row in rows.items():
        try:
            wanted[name] = config_of(asked, world, name, shortest[0] is not None)
        except ConfigError as error:
            row["reason"] = str(error)
    with contextlib.ExitStack() as stack:
        children, said = launch_children(stack, wanted, args.budget, missions_of(asked, world))
        for name, about in said.items():
            rows[name] |= about
        began = time.perf_counter()
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            for name, child in list(children.items()):
                try:
                    turn = child.ask(str(seed))
                except ChildEndedError as error:
                    rows[name]["reason"] = f"its process ended in seed {seed}: {error}"
                    del children[name]
                    continue
                turn["flights"]["shortest_m"] = shortest[: len(turn["flights"]["outcome"])]
                rows[name]["turns"].append(turn)
            done = seed - args.first_seed + 1
            left = (time.perf_counter() - began) / done * (args.seeds - done)
            yield list(rows.values())
            tell(f"{world}: seed {seed} is done" + (f", about {format_duration(left)} left" if left else ""))


def measure_rates(asked: Asked) -> dict[str, Any] | None:
    """Measures decisions per second of E-DQN's whole step and of the conventional stack, in turns.

    Both have the replay ratio `flags.SAMPLES` and the VAE learning throughout, on the paper's world.

    Returns:
        `turns` by method and setting, and `reason`, why they could not be measured; None if they were not requested.
    """
    args = asked.words
    if "paper" not in asked.configs or not {"E-DQN", STACK} <= set(args.methods):
        return None
    config = for_timing(["--world", "paper", "--num-envs", str(DRONES), *asked.flags])
    ours, theirs = STEADY
    # A short warm-up for the conventional stack, for which the decisions of one of our chunks take minutes.
    wanted = {theirs: steady(supported_config(config), 4), ours: steady(config, config.train.chunk_steps)}
    with contextlib.ExitStack() as stack:
        children, said = launch_children(stack, wanted)
        report: dict[str, Any] = {"turns": {}, "reason": None, **said[ours]}
        for name in STEADY:
            if name not in children:
                report["reason"] = f"{name.partition(',')[0]}: {said[name]['reason']}"
                return report
        for number in range(QUICK_TURNS if args.quick else TURNS):
            for name, child in children.items():
                method = name.partition(",")[0]
                try:
                    rates = child.ask(str(number))["decisions_per_second"]
                except ChildEndedError as error:
                    report["reason"] = f"{method}: its process ended in turn {number}: {error}"
                    return report
                for setting, rate in rates.items():
                    report["turns"].setdefault(f"{method}, {setting}", []).append(rate)
    return report


def expected(asked: Asked, world: str) -> str:
    """Returns the estimated duration as a sentence, with one minute per learner for compilation."""
    args = asked.words
    learners = [name for name in args.methods if name in LEARNERS]
    improving = [name for name in args.methods if name in IMPROVING]
    each = args.seeds * asked.configs[world].train.total_steps
    stack = STACK in args.methods and world not in FAMILIES  # it supports only one world
    planning = args.seeds * len(improving) * missions_of(asked, world) * args.budget
    seconds = each * len(learners) / GUESS + each * stack / STACK_GUESS + planning + 60 * len(learners)
    return (
        f"{each * (len(learners) + stack):,} decisions to train, {planning:.0f} s to plan; "
        f"about {seconds / 60:.0f} min on two cores"
    )


def tell(text: str) -> None:
    """Prints progress to standard error."""
    print(text, file=sys.stderr, flush=True)


def report_of(rows: Sequence[Row], rates: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns the report that `--json` writes."""
    ran = next((row for row in rows if row["turns"]), None)
    return {
        "benchmark": "runtime",
        "workload": ran["workload"] if ran else {},
        "device": ran["device"] if ran else None,
        "devices": ran["devices"] if ran else [],
        "versions": ran["versions"] if ran else {},
        "rows": [{**row, **figures(row)} for row in rows],
        "rates": list(rates),
        "worth": [dataclasses.asdict(one) for one in worth(rows)],
        "paper": {"source": table.PAPER_SOURCE, "run_time_s": table.PAPER_RUN_TIME_S},
    }


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 after the measurement, whatever the results; 2 for invalid input."""
    keep_to_cpu()
    asked = parse(argv)
    rows = measure(asked)
    measured = measure_rates(asked)
    rates = [*([measured] if measured else []), *(rate for report in asked.added for rate in report["rates"])]
    complaints = []
    try:
        rows = join_rows([*rows, *(row for report in asked.added for row in report["rows"])])
    except ConfigError as error:  # the new rows must not be lost
        complaints.append(f"{error}; the added rows are left out")
    try:
        if asked.words.json is not None:
            json_report.write_row(asked.words.json, report_of(rows, rates))
        if asked.words.figure is not None:
            draw_runtime(rows, asked.words.figure)
    except ConfigError as error:
        complaints.append(str(error))
    for complaint in complaints:
        tell(complaint)
    print(table.text(rows, rates))  # after the files are written, because the pipe may be closed
    return 2 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
