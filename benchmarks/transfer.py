"""Does a policy fly where the picture, the events or the flight are not ours?

Flies the exported policy through its runner. MuJoCo's OpenGL renderer draws the MJCF that the package writes, RotorPy
flies with drag, motor lag and an SE3 controller, evlib's ESIM (346 x 260 pixels, contrast 0.2) makes the events, and C
MuJoCo judges collisions. Each part can be changed alone. Needs the extras `export` and `transfer`, and EGL or OSMesa
for MuJoCo's pictures.

    python benchmarks/transfer.py --world rooms --picture mujoco --look plain --missions 20
    python benchmarks/transfer.py --world medium --picture mujoco --look textured --flight rotorpy --events esim
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from edqn_jax.errors import ConfigError
from edqn_jax.interop.outer.opengl import load_mujoco

try:
    load_mujoco()
except ConfigError as error:
    if __name__ != "__main__":
        raise
    print(error, file=sys.stderr)
    sys.exit(2)

from measurement.command import Parser, at_least_one, in_a_sentence

import jax
import numpy as np
from numpy.typing import NDArray

import edqn_jax
from edqn_jax.config import Config
from edqn_jax.evaluation.judge import clearance, load_judge, replay_contact
from edqn_jax.evaluation.metrics import wilson_interval
from edqn_jax.interop.deployment.onnx_export import export_policy
from edqn_jax.interop.deployment.runner import Runner
from edqn_jax.interop.outer import event_cameras, pictures
from edqn_jax.interop.outer.poses import Track
from edqn_jax.runs.policies import load_policy
from edqn_jax.runs.provenance import describe_workload
from edqn_jax.sim.environment import Environment
from edqn_jax.sim.task.observation import MAX_YAW_RATE, knows_contrast
from measurement import json_report
from outer import flights


@dataclasses.dataclass(frozen=True)
class Flown:
    """How one mission ended."""

    outcome: str
    """`goal`, `collision`, `left volume` or `time out`."""
    decisions: int
    clearance_m: float
    """Least distance from the body sphere to a solid, by C MuJoCo, at the poses of decisions; 0 after a collision."""


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments.

    Raises:
        ConfigError: if the file of `--json` cannot be written, or two options do not go together.
    """
    parser = Parser("transfer", __doc__)
    parser.add_argument(
        "--policy", type=Path, default=Path("pretrained"), help="folder of a run, or a policy of the package"
    )
    parser.add_argument("--world", default="rooms", help="random worlds by name (default rooms)")
    parser.add_argument("--picture", choices=("mujoco", "own"), default="mujoco", help="who draws (default mujoco)")
    parser.add_argument("--look", choices=pictures.LOOKS, default="plain", help="of MuJoCo's picture (default plain)")
    parser.add_argument("--events", choices=("pair", "esim", "v2e"), default="pair", help="whose law (default pair)")
    parser.add_argument("--flight", choices=flights.KINDS, default="own", help="who flies (default own)")
    parser.add_argument("--mount", choices=("level", "body"), help="of the camera (default the policy's own)")
    parser.add_argument("--missions", type=at_least_one, default=20, help="number of missions (default 20)")
    parser.add_argument("--seed", type=int, default=0, help="seed of missions and looks (default 0)")
    args = parser.parse(argv)
    if args.picture == "own" and args.look != "plain":
        raise ConfigError(f"--look {args.look} is of MuJoCo's picture; with --picture own leave it out")
    return args


def fly_mission(
    runner: Runner, flight: flights.Flight, camera: event_cameras.EventCamera, environment: Environment, mission: int
) -> Flown:
    """Flies one mission through the runner; C MuJoCo judges collisions along the poses.

    Args:
        flight: at rest at the mission's start.
        camera: that has seen nothing yet.
        environment: whose worlds these are.
    """
    config, scene = environment.config, environment.scene(mission)
    goal, volume = np.asarray(scene.goal, np.float64), np.asarray(scene.volume, np.float64)
    judge = load_judge(pictures.spec_of(environment, mission, "plain", 0), config.drone.body_radius_m)
    body = flight.body()
    track = Track(np.zeros(1), body.position[None], body.quaternion[None])
    window = runner.window_us / 1e6
    runner.reset()
    for decision in range(config.env.max_decisions):
        now = decision * runner.period_s
        body = flight.body()
        command = runner.decide(
            camera.watch(track, now - window, now),
            round(1e6 * now),
            position=body.position,
            quaternion=body.quaternion,
            velocity=body.velocity,
            yaw_rate=body.yaw_rate,
            goal=goal,
            volume=volume,
            attitudes=[track.at(now + 1e-6 * each)[1] for each in runner.about["frame_times_us"]],
        )
        way = flight.fly(command, runner.period_s)
        places = np.concatenate([track.position[-1:], way.position])
        outcome = _outcome(config, places, goal, volume, replay_contact(judge, places))
        track = track.then(dataclasses.replace(way, time=way.time + now))
        if outcome is not None:
            break
    else:
        outcome = "time out"
    nearest = min(clearance(judge, place)[0] for place in track.position[::4])
    return Flown(outcome, decision + 1, 0.0 if outcome == "collision" else nearest)


def _outcome(
    config: Config, places: NDArray[np.float64], goal: NDArray[np.float64], volume: NDArray[np.float64], contact: Any
) -> str | None:
    """Returns how a decision along `places` [K, 3] ended, what came first; None if it flies on."""
    ends = {
        "goal": np.linalg.norm(places - goal, axis=1) <= config.env.goal_radius_m,
        "left volume": np.any((places < volume[0]) | (places > volume[1]), axis=1),
    }
    first = {name: int(np.argmax(met)) for name, met in ends.items() if met.any()}
    if contact is not None:
        first = {"collision": contact.segment + contact.fraction} | first
    return min(first, key=lambda name: first[name]) if first else None


def prepare_camera(
    args: argparse.Namespace, config: Config, environment: Environment, mission: int
) -> tuple[event_cameras.EventCamera, Callable[[], None]]:
    """Returns a camera that watches a mission, and what closes it."""
    lens = config.camera
    if has_fine_camera(args, config):
        lens = dataclasses.replace(lens, width=event_cameras.WIDE, height=event_cameras.HIGH)
    if args.picture == "own":
        see = pictures.own_pictures(dataclasses.replace(config, camera=lens), environment, mission)
        close: Callable[[], None] = _nothing
    else:
        spec = pictures.spec_of(environment, mission, args.look, args.seed * 10_000 + mission)
        drawn = pictures.mujoco_pictures(spec, lens)
        see, close = drawn.see, drawn.close
    if args.events == "pair":
        return event_cameras.PairCamera(config.events, see, args.mount), close
    emulator = event_cameras.esim() if args.events == "esim" else event_cameras.v2e()
    return event_cameras.FrameByFrame(emulator, see, args.mount), close


def notes(args: argparse.Namespace, config: Config) -> list[str]:
    """Returns a sentence on each thing that the policy never saw in its training."""
    said = []
    if args.mount != config.camera.mount:
        said.append(
            f"this policy was trained with camera.mount {config.camera.mount} alone, and flies with {args.mount}"
        )
    if config.surface.pattern == "plaid" and args.picture == "mujoco":
        said.append(f"this policy was trained with surface.pattern plaid alone; MuJoCo's picture is {args.look}")
    return said


def has_fine_camera(args: argparse.Namespace, config: Config) -> bool:
    """Returns whether the events are those of a camera of more pixels than the policy has."""
    return args.events != "pair" or config.events.sensor_pixels > 1


def contrast_of(args: argparse.Namespace, config: Config) -> float | None:
    """Returns the contrast that the runner is told; None is the policy's own."""
    if args.events != "pair":
        return event_cameras.CONTRAST
    return config.events.tolerance if knows_contrast(config) else None


def _nothing() -> None: ...


def measure(args: argparse.Namespace, show: Callable[[str], None] = print) -> dict[str, Any]:
    """Returns the report that `--json` writes, and shows each mission's end."""
    policy = load_policy(args.policy)
    config = policy.config
    args.mount = args.mount or config.camera.mount
    for note in notes(args, config):
        show(note)
    environment = edqn_jax.make(args.world, config, worlds=args.missions, seed=args.seed, split="test")
    ended: list[Flown] = []
    with tempfile.TemporaryDirectory() as folder:
        file = export_policy(policy, Path(folder) / "policy.onnx").file
        fine = has_fine_camera(args, config)
        runner = Runner(
            file,
            camera=(event_cameras.WIDE, event_cameras.HIGH) if fine else None,
            camera_fov_deg=config.camera.horizontal_fov_deg if fine else None,
            contrast=contrast_of(args, config),
        )
        for mission in range(args.missions):
            watcher, close = prepare_camera(args, config, environment, mission)
            try:
                flight = flights.start_flight(args.flight, environment, mission, MAX_YAW_RATE)
                ended.append(fly_mission(runner, flight, watcher, environment, mission))
            finally:
                close()
            show(f"mission {mission}: {ended[-1].outcome}, {ended[-1].clearance_m:.2f} m clear at least")
    return {
        "workload": describe_workload(config, environment.scene(0)),
        **json_report.machine(jax.devices()),
        "cell": {name: str(getattr(args, name)) for name in CELL},
        "missions": [dataclasses.asdict(each) for each in ended],
        **summary(ended),
    }


CELL = ("policy", "world", "picture", "look", "events", "flight", "mount", "seed")
"""The options that say what was flown."""


def summary(ended: Sequence[Flown]) -> dict[str, Any]:
    """Returns the success rate with its Wilson interval, and the least clearance of half of the successful flights."""
    flown = sum(each.outcome == "goal" for each in ended)
    low, high = wilson_interval(flown, len(ended))
    clear = [each.clearance_m for each in ended if each.outcome == "goal"]
    return {
        "flown": flown,
        "of": len(ended),
        "rate": flown / len(ended),
        "rate_low": low,
        "rate_high": high,
        "median_least_clearance_m": float(np.median(clear)) if clear else None,
    }


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0, or 2 for invalid input."""
    args = parse(argv)
    report = measure(args)
    interval = f"{100 * report['rate_low']:.0f} to {100 * report['rate_high']:.0f} %"
    print(f"{report['flown']} of {report['of']} flown ({interval}, Wilson); collisions by C MuJoCo")
    json_report.write(args.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
