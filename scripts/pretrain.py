r"""Makes a policy that comes with the package: trains five seeds, measures the best and writes its model card.

    python scripts/pretrain.py --run runs/pretrained --out edqn_jax/policies/pretrained
    python scripts/pretrain.py --kind looks --run runs/looks --out runs/looks-first
    python scripts/pretrain.py --kind further --start-from runs/looks-first --run runs/further \
        --out runs/looks-further
    python scripts/pretrain.py --kind autopilot --world narrow --start-from runs/looks-further --run runs/autopilot \
        --seeds 1 --measured runs/looks.md --out edqn_jax/policies/pretrained-looks
    python scripts/pretrain.py --kind late --world narrow --start-from edqn_jax/policies/pretrained-looks \
        --run runs/late --seeds 1 --out edqn_jax/policies/pretrained-late
    python scripts/pretrain.py --kind body --world narrow --start-from edqn_jax/policies/pretrained-looks \
        --run runs/body --seeds 1 --out edqn_jax/policies/pretrained-body

Training needs a GPU: for `mixed` worlds 24 minutes on two H100, 16 of them training (`train.py ... --train.devices 2`,
with the options that this script has), for `open` ones eight on one. Where --run holds the seeds already, the best is
only measured, which takes half an hour on one core for six families, most of it A* for the SPL; a policy of any look
is measured for each of --looks. The best seed is the one with the highest success in the validation worlds, SPL among
equals; nothing that is measured afterwards has a say in it.

The card of a policy of any look has a place for what other commands measure: true depth and blind, verdicts, the parts
of others, the wire. Such figures come from the Markdown of --measured, a section `### NAME` each (`### Limits` adds to
the limits), and the card names the command of those that are missing.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import model_card
from edqn_jax.config import EXACT, MIXTURES
from edqn_jax.config.simulation import LOOKS as PATTERNS
from edqn_jax.devices.devices import use_cpu_devices
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.evaluate import evaluate, evaluate_look
from edqn_jax.files import write_atomically
from edqn_jax.learn.policy import Policy
from edqn_jax.runs.policies import load_policy, save_policy

ROOT = Path(__file__).resolve().parents[1]

SEEDS = 5
"""Agents that are trained together; the best of them is shipped."""

FLAGS = ("--tuned-for", "gpu", "--world.flown", "", "--train.keep", "last")
"""Options of train.py beside the world, what depends on it, and the number of seeds."""

LOOKS = (
    *("--surface.pattern", "drawn", "--events.frame-times-s", "-0.16", "-0.08", "0.0"),
    *("--events.profile", "dvs", "--events.least-contrast", "0.02", "--events.most-contrast", "0.3"),
    *("--events.faults-share", "1", "--events.sensor-pixels", "117"),
    *("--encoder.patch-layers", "128", "64", "24", "--encoder.joint-layers", "512", "256"),
    *("--encoder.patch-overlap", "2", "--encoder.warmup-updates-per-step", "64"),
    *("--encoder.retrain-at", "0.08", "0.3", "--encoder.retrain-decisions", "6291456"),
    *("--encoder.final-learning-rate", "1e-4", "--env.closeness-weight", "0.25", "--air.drag"),
    *("--body.mass-share", "0.2", "--motors.gain-share", "0.2", "--motors.lag-s", "0.05"),
    *("--train.validation-missions", "64"),
)
"""Further options of the policy of any look (docs/surfaces.md): surfaces and event sensors that are drawn, a third
frame, from which motion shows, an encoder that is larger and learns five times as long, errors of tracking."""

AGAIN = (
    *("--encoder.warmup-decisions", "2097152", "--encoder.learning-rate", "1e-3"),
    *("--agent.exploration-start", "0.2", "--agent.exploration-fraction", "0.05"),
)
"""What begins with a policy: its encoder learns again, by smaller steps; a fifth of the moves are random at first."""

AUTOPILOT = ("--env.setpoint-m-s2", "4", "--env.setpoint-share", "0.75")
"""Three quarters of the episodes have an autopilot that changes the velocity it holds slowly."""

LATE = ("--env.action-delay", "1", "--env.delay-share", "0.5", "--agent.last-move")
"""In half of the episodes moves are flown a decision late; the Q-network knows the move that is about to be flown."""

BODY = ("--camera.mount", "body", "--encoder.levelled")

VALIDATED_EVERY = {"open": 20_000_000, "mixed": 0, "narrow": 0}
"""Decisions between validations, by the worlds; 0 validates at the end alone: several seeds take minutes for one."""

DECISIONS = {"open": 60_000_000, "mixed": 300_000_000, "narrow": 300_000_000}
"""Decisions of each seed, by the worlds that can be trained on."""

KINDS: dict[str, tuple[int, tuple[str, ...]]] = {
    "plaid": (0, ("--surface.pattern", "plaid")),
    "looks": (220_000_000, LOOKS),
    "further": (185_000_000, (*LOOKS, *AGAIN, "--encoder.retrain-at", "0.05", "0.35")),
    "autopilot": (370_000_000, (*LOOKS, *AGAIN, *AUTOPILOT, "--encoder.retrain-at", "0.05", "0.35")),
    "late": (170_000_000, (*LOOKS, *AGAIN, *AUTOPILOT, *LATE, "--encoder.retrain-at", "0.05", "0.35")),
    "body": (150_000_000, (*LOOKS, *AGAIN, *AUTOPILOT, *BODY, "--encoder.retrain-at", "0.06", "0.3")),
}
"""Decisions of each seed, 0 as `DECISIONS`, and further options, by the kind of policy: of one plaid, of any look, the
latter trained further, for a slow autopilot, also for moves that are late, and with a camera on the body; these four
begin with one of any look."""

BEGIN = ("further", "autopilot", "late", "body")
"""Kinds that begin with a policy of any look."""

MISSIONS = 1000
"""Test worlds of each family; training never uses them."""

TEST_SEED = 11
"""Of the test missions of a policy of any look."""


def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 when the policy and its card are written, 2 for invalid input."""
    args = parse(argv)
    trained = args.run.is_dir()
    try:
        _check_replaceable(args.out)
        measured = {} if args.measured is None else read_measured(args.measured)
        if not trained:
            begin = [] if args.start_from is None else ["--start-from", str(args.start_from)]
            _train(args.run, [*options_of(args.world, args.kind), *begin], args.first_seed, args.seeds)
        use_cpu_devices()
        run = best_of(args.run, args.seeds)
        policy = load_policy(run)
        if (found := policy.config.world.name) != args.world:
            raise ConfigError(f"'{args.run}' was trained in '{found}' worlds, not '{args.world}'; give --world {found}")
        card = measure(args, policy, run, measured)
        shutil.rmtree(args.out, ignore_errors=True)
        save_policy(policy, args.out)
        write_atomically(args.out / "README.md", card)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    print(card)
    return 0


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Returns the parsed arguments; ends the program where they are invalid."""
    parser = argparse.ArgumentParser(
        prog="python scripts/pretrain.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--run", type=Path, required=True, help="folder of the runs; trained if there are none")
    parser.add_argument("--out", type=Path, required=True, help="folder of policy and card; replaced")
    parser.add_argument("--world", choices=sorted(DECISIONS), default="mixed", help="to train on (default mixed)")
    parser.add_argument("--kind", choices=sorted(KINDS), default="plaid", help="of policy (default plaid)")
    parser.add_argument("--start-from", type=Path, help=f"policy that {_listed(BEGIN)} begin with")
    parser.add_argument("--seeds", type=int, default=SEEDS, help=f"agents that are trained (default {SEEDS})")
    parser.add_argument("--first-seed", type=int, default=0, help="of the first agent (default 0)")
    parser.add_argument("--missions", type=int, default=MISSIONS, help=f"test worlds of a family (default {MISSIONS})")
    parser.add_argument("--test-seed", type=int, help=f"of the test missions (default {TEST_SEED}, of one plaid 0)")
    parser.add_argument("--looks", nargs="+", choices=PATTERNS, help="that are flown (default all; not for one plaid)")
    parser.add_argument("--measured", type=Path, help="Markdown of what other commands measured; not for one plaid")
    parser.add_argument("--trained", help="where and how long the run was trained, if its summary.json does not say")
    parser.add_argument("--commit", help="commit that the run was trained at; needed if it is not trained now")
    args = parser.parse_args(argv)
    for name in ("missions", "seeds"):
        if getattr(args, name) < 1:
            parser.error(f"--{name} must be at least 1, not {getattr(args, name)}")
    if (args.kind in BEGIN) != (args.start_from is not None):
        parser.error(f"--start-from is for the kinds {_listed(BEGIN)}, and needed there")
    if args.kind == "plaid" and (args.looks or args.measured):
        parser.error("--looks and --measured are for the kinds of any look")
    if args.run.is_dir() and args.commit is None:
        parser.error(f"'{args.run}' was trained before; say with --commit at which commit")
    if args.test_seed is None:
        args.test_seed = 0 if args.kind == "plaid" else TEST_SEED
    return args


def _listed(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"


def measure(args: argparse.Namespace, policy: Policy, run: Path, measured: dict[str, str]) -> str:
    """Returns the card of a policy, which flies its test worlds.

    Args:
        args: of `parse`.
        policy: the best of the seeds.
        run: of that seed.
        measured: what other commands measured, see `model_card.sections_of`.
    """
    paper = {each: evaluate(load_policy(each), "paper", conditions=EXACT) for each in seeds_of(args.run, args.seeds)}
    origin = model_card.Origin(
        folder=args.out,
        kind=args.kind,
        validations={load_policy(each).config.train.seed: _validation(each)[0] for each in paper},
        arrived=sum(each.figures["successes"] for each in paper.values()),
        trained=args.trained or _trained(run),
        commit=args.commit or _commit(),
        began_with=args.start_from,
    )
    families, missions, seed = families_of(policy), args.missions, args.test_seed
    if args.kind == "plaid":
        flown = {world: evaluate(policy, world, missions=missions, seed=seed) for world in families}
        return model_card.plaid_card(policy, origin, flown, paper[run])
    looks = {
        look: {
            world: evaluate_look(policy, world, look, missions=missions, seed=seed, exact=True) for world in families
        }
        for look in args.looks or PATTERNS
    }
    return model_card.looks_card(policy, origin, looks, paper[run], seed, measured)


def read_measured(file: Path) -> dict[str, str]:
    """Returns the sections of a file of measurements.

    Raises:
        ConfigError: if it cannot be read, or is no such file.
    """
    try:
        return model_card.sections_of(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"'{file}' cannot be read: {error}") from None


def options_of(world: str, kind: str = "plaid") -> list[str]:
    """Returns the options of train.py for these worlds and a kind of policy, without seeds, folder and beginning."""
    decisions, further = KINDS[kind]
    numbers = {"--total-steps": decisions or DECISIONS[world], "--train.validation-every": VALIDATED_EVERY[world]}
    words = [*FLAGS, "--world", world, *(word for name, number in numbers.items() for word in (name, str(number)))]
    return [*words, *further]


def families_of(policy: Policy) -> list[str]:
    """Returns the families of the random worlds that a policy was trained on."""
    name = policy.config.world.name
    return list(MIXTURES.get(name, [name]))


def best_of(folder: Path, seeds: int = SEEDS) -> Path:
    """Returns the run of the seed with the highest success in the validation worlds, SPL among equals.

    Raises:
        ConfigError: if the folder holds fewer finished runs.
    """
    return max(seeds_of(folder, seeds), key=_validation)


def seeds_of(folder: Path, seeds: int = SEEDS) -> list[Path]:
    """Returns the runs of the seeds that a folder holds.

    Raises:
        ConfigError: if another number of them is finished.
    """
    runs = sorted((file.parent for file in folder.glob("seed-*/summary.json")), key=lambda run: (len(run.name), run))
    if len(runs) < seeds:
        raise ConfigError(
            f"'{folder}' holds {len(runs)} finished seeds of {seeds}; continue it with train.py --run-dir"
        )
    if len(runs) > seeds:
        raise ConfigError(f"'{folder}' holds {len(runs)} finished seeds; give --seeds {len(runs)}, so that all count")
    return runs


def _validation(run: Path) -> tuple[float, float]:
    """Returns success and SPL of a run in the validation worlds."""
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    return summary["validation_success"], summary["validation_spl"]


def _train(run: Path, options: Sequence[str], first: int, seeds: int) -> None:
    asked = [*options, "--seed", str(first), "--seeds", str(seeds), "--run-dir", str(run)]
    code = subprocess.run([sys.executable, str(ROOT / "train.py"), *asked]).returncode
    if code:
        raise ConfigError(f"the training in '{run}' ended with exit code {code}; what it printed says why")


def _check_replaceable(folder: Path) -> None:
    """Raises unless a folder is new, or holds a policy alone.

    Raises:
        ConfigError: names what else is in it.
    """
    others = (
        {file.name for file in folder.iterdir()} - {"config.yaml", "checkpoints", "README.md"}
        if folder.is_dir()
        else set()
    )
    if others:
        raise ConfigError(f"'{folder}' holds other files, such as '{min(others)}'; give a folder that can be replaced")


def _trained(run: Path) -> str:
    """Returns where and how long a run was trained.

    Raises:
        ConfigError: if its summary is missing.
    """
    file = run / "summary.json"
    if not file.is_file():
        raise ConfigError(f"'{run}' holds no summary.json; say with --trained where and how long it was trained")
    summary = json.loads(file.read_text(encoding="utf-8"))
    return (
        f"{summary['train_seconds']:.0f} s, and {summary['compile_seconds']:.0f} s of compiling, on "
        f"{', '.join(summary['devices'])}"
    )


def _commit() -> str:
    return subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
