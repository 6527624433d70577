"""Makes the policy that comes with the package: trains it, measures it and writes its model card.

    python scripts/pretrain.py --run runs/pretrained --out edqn_jax/policies/pretrained

Training needs a GPU (two minutes on an H100, and one of compiling); where --run holds a policy already, it is only
measured, which takes ten minutes on two cores, most of it A* for the SPL.
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
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.evaluate import Evaluation, evaluate
from edqn_jax.learn.policy import Policy
from edqn_jax.parallel.devices import use_cpu_devices
from edqn_jax.runs.files import write_atomically
from edqn_jax.runs.policies import load_policy, save_policy

ROOT = Path(__file__).resolve().parents[1]

FLAGS = (
    *("--tuned-for", "gpu", "--world", "mixed", "--total-steps", "60000000", "--train.keep", "last"),
    *("--agent.updates-per-step", "16", "--encoder.warmup-updates-per-step", "48"),
    *("--agent.huber-delta", "1", "--env.collision-reward", "-100", "--env.left-volume-reward", "-100"),
    *("--agent.no-turn", "--world.flown", ""),
)
"""Options of train.py: the defaults of a GPU when the policy was trained, with more updates. They are named where they
have changed since, so that the configuration is the shipped one."""

DENSITIES = ("sparse", "medium", "dense")
MISSIONS = 1000
"""Test worlds of each density; training never uses them."""

CARD = """# Model card: `pretrained`

A policy for random worlds of every density, flown from simulated events. `edqn evaluate pretrained --world FILE.xml`
flies it, `edqn_jax.load_policy("pretrained")` loads it.

| | |
| --- | --- |
| trained on | {pool:,} random worlds of mixed density (`--world mixed`, the training split), {missions:,} missions |
| training | {decisions:,} decisions in {envs:,} environments, seed {seed}, last averaged parameters; {trained} |
| sees | events of the last {window:g} s (threshold {threshold:g}), its own state and motion |
| camera | level, {width} x {height} pixels, {fov:g} degrees across |
| format | configuration in `config.yaml`, parameters as an Orbax checkpoint (arrays, no pickle) |
| trained at | commit `{commit}`, with the options in `config.yaml` |
| made by | `scripts/pretrain.py`, which trains with these options, edqn_jax {version} |

## Measured

Greedy flights through test worlds, which neither training nor any choice has used; physics by MJX.

| world | missions | success | 95 % interval (Wilson) | SPL | collisions | other failures |
| --- | ---: | ---: | ---: | ---: | ---: | ---: |
{rows}

The paper's own map, never trained on: {paper}

## Limits

- One training seed; another one flies half a point to a point more or less ([ablation](../../../docs/ablation.md)).
- Simulated events from rendered brightness: no noise, no lens, uniform thresholds, static worlds, no wind. It has not
  been flown on a real drone, and must not be.
- The map's bounds matter: the own position is given relative to the flight volume, and worlds of other sizes than
  110 x 110 x 25 m have not been measured.
- It collides with obstacles in full view and with ones just outside of the camera's view:
  `benchmarks/failures.py pretrained --world medium` lists them.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 when the policy and its card are written, 2 for invalid input."""
    parser = argparse.ArgumentParser(
        prog="python scripts/pretrain.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--run", type=Path, required=True, help="folder of the run; trained if it holds no policy")
    parser.add_argument("--out", type=Path, required=True, help="folder of policy and card; replaced")
    parser.add_argument("--missions", type=int, default=MISSIONS, help=f"test worlds of a density (default {MISSIONS})")
    parser.add_argument("--trained", help="where and how long the run was trained, if its summary.json does not say")
    parser.add_argument("--commit", help="commit that the run was trained at; needed if it is not trained now")
    args = parser.parse_args(argv)
    if args.missions < 1:
        parser.error(f"--missions must be at least 1, not {args.missions}")
    trained = (args.run / "checkpoints" / "policy").is_dir()
    if trained and args.commit is None:
        parser.error(f"'{args.run}' was trained before; say with --commit at which commit")
    try:
        _check_replaceable(args.out)
        if not trained:
            _train(args.run)
        use_cpu_devices()
        policy = load_policy(args.run)
        flown = {world: evaluate(policy, world, missions=args.missions) for world in DENSITIES}
        card = card_of(
            policy,
            flown,
            evaluate(policy, "paper"),
            args.trained or _trained(args.run),
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


def card_of(policy: Policy, flown: dict[str, Evaluation], paper: Evaluation, trained: str, commit: str) -> str:
    """Returns the model card of a policy and its flights."""
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
        pool=config.world.pool_size,
        missions=config.world.missions,
        decisions=config.train.total_steps,
        envs=config.train.num_envs,
        seed=config.train.seed,
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


def _paper(figures: dict[str, Any], radius: float) -> str:
    if not figures["successes"]:
        return "it does not reach the goal."
    return (
        f"it reaches the goal after {figures['decisions']:.0f} decisions (the paper: 188), "
        f"{figures['path_length_m']:.1f} m ({figures['path_over_shortest']:.2f} times A*'s path), with "
        f"{figures['min_clearance_m']:.2f} m "
        f"({figures['min_clearance_m'] / radius:.1f} body radii) to spare."
    )


def _train(run: Path) -> None:
    code = subprocess.run([sys.executable, str(ROOT / "train.py"), *FLAGS, "--run-dir", str(run)]).returncode
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
