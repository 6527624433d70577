"""Which sensor sees in which light, and how fast? Trains policies in drawn light and flies them in each light alone.

A row is a sensor at a speed: five seeds trained in one program, each episode in a light of its own, drawn
log-uniformly between the first and the last of --lux. Each policy then flies the same test missions in each light.
Events come from the profile `dvs` with the thresholds of random worlds, frames from `exposure.real`, so all sensors
have noise, and frames the blur and the exposure of their light.

    python benchmarks/light.py --out runs/light
    python benchmarks/light.py --out runs/light --sensors events --speeds 8 -- --total-steps 20000000
    python benchmarks/light.py --out runs/light --report

A row is written when it is done, with the policies, and is not measured again; no row is begun that would not end in
time. --train-only is as in success.py. Arguments after -- are options of train.py; defaults are those of the hardware.
Intervals are a bootstrap over seeds and missions, 95 %.
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import functools
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import success
from edqn_jax.config import FAMILIES, Config
from edqn_jax.config.loading import with_conditions
from edqn_jax.devices.devices import most_that_divide, use_cpu_devices
from edqn_jax.devices.hardware import count_cores
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.missions import load_missions
from edqn_jax.files import check_can_make
from measurement.flags import split

REAL = ("--exposure.real",)
SENSORS: dict[str, tuple[str, ...]] = {
    "events": ("--events.profile", "dvs", "--events.threshold", "0.03", "--events.tolerance", "0.03"),
    "frames": REAL,
    "frame-pair": REAL,
}
"""By sensor: the options that make it as imperfect as a real one."""


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments; `flags` are those after --."""
    words, flags = split(argv)
    parser = Parser("light", __doc__, json=None)
    lights = [0.1, 1.0, 10.0, 100.0, 1000.0, 10_000.0]
    parser.add_argument("--out", type=Path, required=True, help="folder of rows and policies")
    parser.add_argument("--world", default="medium", choices=FAMILIES, help="(default medium)")
    parser.add_argument("--sensors", nargs="+", default=list(SENSORS), choices=SENSORS, help="(default all)")
    parser.add_argument("--speeds", nargs="+", type=float, default=[4.0, 8.0], help="env.speed_m_s (default 4 8)")
    parser.add_argument("--lux", nargs="+", type=float, default=lights, help="(default 0.1 1 10 100 1000 10000)")
    parser.add_argument("--seeds", type=at_least_one, default=5, help="training seeds, in one program (default 5)")
    parser.add_argument(
        "--missions", type=at_least_one, default=1000, help="test missions in each light (default 1000)"
    )
    parser.add_argument("--minutes", type=float, default=9.0, help="begin no row that would end later (default 9)")
    parser.add_argument("--train-only", action="store_true", help="leave the flights to a later call, on any machine")
    parser.add_argument("--report", action="store_true", help="measure no row, print those in --out")
    args = parser.parse(words)
    args.flags = flags
    if args.report and args.train_only:
        parser.error("--report measures nothing; leave out --train-only")
    if sorted(args.lux) != args.lux:
        parser.error("--lux must go from dark to bright")
    return args


def config_of(args: argparse.Namespace, sensor: str, speed: float) -> Config:
    """Returns the configuration of a row's first seed.

    Raises:
        ConfigError: if the options are invalid.
    """
    light = ("--light.least-lux", str(args.lux[0]), "--light.most-lux", str(args.lux[-1]))
    return success.config_of(args.world, sensor, [*light, *SENSORS[sensor], "--env.speed-m-s", str(speed), *args.flags])


def measure_row(config: Config, args: argparse.Namespace, folder: Path) -> success.Row:
    """Trains the seeds of a row, saves their policies in `folder`, flies each light, and returns the row."""
    began = time.perf_counter()
    row = success.train_row(config, args.seeds, args.missions, folder)
    policies, _ = success.trained(config, args.seeds, folder)
    lights = []
    for lux in args.lux:
        lit = with_conditions(config, {"light": {"least_lux": lux, "most_lux": lux}}, "--lux")
        course = load_missions(lit, args.world, args.missions)
        lights.append({"lux": lux, "turns": success.turns_of(lit, policies, course.env_params, args.missions)})
    took = {"row_seconds": time.perf_counter() - began}
    return row | took | {"benchmark": "light", "speed_m_s": config.env.speed_m_s, "lights": lights}


def table(rows: Sequence[success.Row]) -> str:
    """Returns success by light as a Markdown table."""
    lights = [light["lux"] for light in rows[0]["lights"]]
    if any([light["lux"] for light in row["lights"]] != lights for row in rows):
        raise ConfigError("the rows were flown in other lights than each other; move some of them to another folder")
    heads = [f"{lux:g} lux" for lux in lights]
    lines = [
        f"| world | m/s | sensor | drawn light | {' | '.join(heads)} | decisions | training, all seeds, s |",
        f"| --- | ---: | --- |{' --- |' * (len(heads) + 1)} ---: | ---: |",
    ]
    for row in sorted(rows, key=lambda row: (row["world"], row["speed_m_s"], list(SENSORS).index(row["sensor"]))):
        cells = [_cell(row), *(_cell(light) for light in row["lights"])]
        lines.append(
            f"| {row['world']} | {row['speed_m_s']:g} | {row['sensor']} | {' | '.join(cells)} "
            f"| {row['decisions']:,} | {row['train_seconds']:.0f} |"
        )
    return "\n".join(lines)


def _cell(flown: dict[str, Any]) -> str:
    found = success.figures(flown, None)
    low, high = found["interval"]
    return f"{found['success']:.1%} ({100 * low:.1f} to {100 * high:.1f})"


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 when every row is there, 3 when rows are left for another call, 2 for invalid input."""
    began = time.perf_counter()
    args = parse(argv)
    check_can_make(args.out)
    rows = success.read_rows(args.out)
    wanted = []
    for speed in [] if args.report else args.speeds:
        for sensor in args.sensors:
            config = config_of(args, sensor, speed)
            use_cpu_devices(most_that_divide(config.train.shards, count_cores()))
            file = success.row_file(args.out, config, args.missions, f"light {args.lux} {args.seeds}")
            folder = success.policies_of(file)
            measure = functools.partial(measure_row, config, args, folder)
            train = functools.partial(success.trained, config, args.seeds, folder)
            wanted.append(success.Wanted(file, measure, train))
    if args.train_only:
        success.train_all(wanted, began + 60 * args.minutes)
        return 3
    left = success.measure(wanted, rows, began + 60 * args.minutes)
    if rows:
        print(table(rows))
    return 3 if left else 0


if __name__ == "__main__":
    sys.exit(main())
