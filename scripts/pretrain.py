r"""Makes a policy that comes with the package: trains five seeds, measures the best and writes its model card.

    python scripts/pretrain.py --run runs/pretrained --out edqn_jax/policies/pretrained
    python scripts/pretrain.py --kind looks --run runs/looks --out runs/looks-first
    python scripts/pretrain.py --kind further --start-from runs/looks-first --run runs/further \
        --out runs/looks-further
    python scripts/pretrain.py --kind autopilot --world narrow --start-from runs/looks-further --run runs/autopilot \
        --out edqn_jax/policies/pretrained-looks
    python scripts/pretrain.py --kind body --world narrow --start-from edqn_jax/policies/pretrained-looks \
        --run runs/body --out edqn_jax/policies/pretrained-body

Training needs a GPU: for `mixed` worlds 24 minutes on two H100, 16 of them training (`train.py ... --train.devices 2`,
with the options that this script has), for `open` ones eight on one. Where --run holds the seeds already, the best is
only measured, which takes half an hour on one core for six families, most of it A* for the SPL. The best seed is the
one with the highest success in the validation worlds, SPL among equals; nothing that is measured afterwards has a say
in it.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import edqn_jax
from edqn_jax.config import MIXTURES
from edqn_jax.devices.devices import use_cpu_devices
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.evaluate import Evaluation, evaluate
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
    "body": (150_000_000, (*LOOKS, *AGAIN, *AUTOPILOT, *BODY, "--encoder.retrain-at", "0.06", "0.3")),
}
"""Decisions of each seed, 0 as `DECISIONS`, and further options, by the kind of policy: of one plaid, of any look, the
latter trained further, for a slow autopilot, and for one with a camera on the body; these three begin with one of any
look."""

MISSIONS = 1000
"""Test worlds of each family; training never uses them."""

CARD = """# Model card: `pretrained`

A policy for random worlds ({families}), flown from simulated events.
`edqn evaluate pretrained --world FILE.xml` flies it, `edqn_jax.load_policy("pretrained")` loads it.

| | |
| --- | --- |
| trained on | {pool:,} worlds (`--world {world} --surface.pattern plaid`, the training split), {missions:,} missions |
| training | {decisions:,} decisions in {envs:,} environments, last averaged parameters; {trained} |
| seed | {seed}, the best of {seeds} in the validation worlds |
| sees | events of the last {window:g} s (threshold {threshold:g}), its own state and motion |
| camera | level, {width} x {height} pixels, {fov:g} degrees across |
| format | configuration in `config.yaml`, parameters in `checkpoints/policy.safetensors` (arrays, no pickle) |
| trained at | commit `{commit}`, with the options in `config.yaml` |
| made by | `scripts/pretrain.py`, which trains with these options, edqn_jax {version} |

## Measured

Greedy flights through test worlds, which neither training nor any choice has used; physics by MJX.

| world | missions | success | 95 % interval (Wilson) | SPL | collisions | other failures |
| --- | ---: | ---: | ---: | ---: | ---: | ---: |
{rows}

The paper's own map, never trained on: {paper}

## Limits

- The best of {seeds} training seeds, of which {arrived} reach the goal of the paper's map.
- Simulated events from rendered brightness: no noise, no lens, uniform thresholds, static worlds, no wind. It has not
  been flown on a real drone, and must not be.
- The map's bounds matter: the own position is given relative to the flight volume, and only worlds of these
  families' sizes have been measured: 110 x 110 x 25 m open ones, 36 to 60 m across closed ones.
- It collides with obstacles in full view and with ones just outside of the camera's view:
  `benchmarks/failures.py pretrained --world medium` lists them.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 when the policy and its card are written, 2 for invalid input."""
    parser = argparse.ArgumentParser(
        prog="python scripts/pretrain.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--run", type=Path, required=True, help="folder of the runs; trained if there are none")
    parser.add_argument("--out", type=Path, required=True, help="folder of policy and card; replaced")
    parser.add_argument("--world", choices=sorted(DECISIONS), default="mixed", help="to train on (default mixed)")
    parser.add_argument("--kind", choices=sorted(KINDS), default="plaid", help="of policy (default plaid)")
    parser.add_argument("--start-from", type=Path, help="policy that `further`, `autopilot` and `body` begin with")
    parser.add_argument("--missions", type=int, default=MISSIONS, help=f"test worlds of a family (default {MISSIONS})")
    parser.add_argument("--trained", help="where and how long the run was trained, if its summary.json does not say")
    parser.add_argument("--commit", help="commit that the run was trained at; needed if it is not trained now")
    args = parser.parse_args(argv)
    if args.missions < 1:
        parser.error(f"--missions must be at least 1, not {args.missions}")
    if (args.kind in ("further", "autopilot", "body")) != (args.start_from is not None):
        parser.error("--start-from is for the kinds further, autopilot and body, and needed there")
    trained = args.run.is_dir()
    if trained and args.commit is None:
        parser.error(f"'{args.run}' was trained before; say with --commit at which commit")
    try:
        _check_replaceable(args.out)
        if not trained:
            begin = [] if args.start_from is None else ["--start-from", str(args.start_from)]
            _train(args.run, [*options_of(args.world, args.kind), *begin])
        use_cpu_devices()
        run = best_of(args.run)
        policy = load_policy(run)
        if (found := policy.config.world.name) != args.world:
            raise ConfigError(f"'{args.run}' was trained in '{found}' worlds, not '{args.world}'; give --world {found}")
        flown = {world: evaluate(policy, world, missions=args.missions) for world in families_of(policy)}
        paper = {each: evaluate(load_policy(each), "paper") for each in seeds_of(args.run)}
        card = card_of(
            policy,
            flown,
            paper[run],
            sum(each.figures["successes"] for each in paper.values()),
            args.trained or _trained(run),
            args.commit or _commit(),
        )
        shutil.rmtree(args.out, ignore_errors=True)
        save_policy(policy, args.out)
        write_atomically(args.out / "README.md", card)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    print(card)
    return 0


def card_of(
    policy: Policy, flown: dict[str, Evaluation], paper: Evaluation, arrived: int, trained: str, commit: str
) -> str:
    """Returns the model card of a policy and its flights; `arrived` of the seeds reach the goal of the paper's map."""
    config = policy.config
    rows = []
    for world, evaluation in flown.items():
        found = evaluation.figures
        low, high = found["interval"]
        others = found["left_volume"] + found["timeouts"] + found["diverged"]
        rows.append(
            f"| {world} | {found['missions']} | {found['success_rate']:.1%} | {low:.1%} to {high:.1%} "
            f"| {found['spl']:.3f} | {found['collisions']} | {others} |"
        )
    return CARD.format(
        families=", ".join(flown),
        world=config.world.name,
        pool=config.world.pool_size,
        missions=config.world.missions,
        decisions=config.train.total_steps,
        envs=config.train.num_envs,
        seed=config.train.seed,
        seeds=SEEDS,
        arrived=arrived,
        trained=trained,
        width=config.camera.width,
        height=config.camera.height,
        fov=config.camera.horizontal_fov_deg,
        threshold=config.events.threshold,
        window=-config.events.frame_times_s[0],
        commit=commit,
        version=edqn_jax.__version__,
        rows="\n".join(rows),
        paper=_paper(paper.figures, config.drone.body_radius_m),
    )


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


def best_of(folder: Path) -> Path:
    """Returns the run of the seed with the highest success in the validation worlds, SPL among equals.

    Raises:
        ConfigError: if the folder holds no finished run of a seed.
    """

    def validation(run: Path) -> tuple[float, float]:
        summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
        return summary["validation_success"], summary["validation_spl"]

    return max(seeds_of(folder), key=validation)


def seeds_of(folder: Path) -> list[Path]:
    """Returns the runs of the seeds that a folder holds.

    Raises:
        ConfigError: if fewer than `SEEDS` are finished.
    """
    runs = sorted(file.parent for file in folder.glob("seed-*/summary.json"))
    if len(runs) < SEEDS:
        raise ConfigError(
            f"'{folder}' holds {len(runs)} finished seeds of {SEEDS}; continue it with train.py --run-dir"
        )
    return runs


def _paper(figures: dict[str, Any], radius: float) -> str:
    if not figures["successes"]:
        return "it does not reach the goal."
    return (
        f"it reaches the goal after {figures['decisions']:.0f} decisions (the paper: 188), "
        f"{figures['path_length_m']:.1f} m ({figures['path_over_shortest']:.2f} times A*'s path), with "
        f"{figures['min_clearance_m']:.2f} m "
        f"({figures['min_clearance_m'] / radius:.1f} body radii) to spare."
    )


def _train(run: Path, options: Sequence[str]) -> None:
    asked = [*options, "--seeds", str(SEEDS), "--run-dir", str(run)]
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
