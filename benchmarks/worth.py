"""When is an event camera worth it? Trains and flies the rows of one axis of the map, or prints and draws the map.

A row is a world, a condition of training and a sensor: several seeds, trained in one program, each of which then flies
the same test missions in every condition of the axis. All rows of an axis have equal decisions and observations in
memory, and two controls: `blind`, which sees nothing, and `depth`, the truth. The axes:

    looks   events, one frame, frame pair and the difference of the pair, trained with one look and with drawn ones,
            flown in looks that were never trained on
    age     decisions at 25 Hz among balls that are thrown late; true depth as it is, and one and two observations old;
            events, frames at the decision, and pairs of cameras of 30 to 200 frames a second (frame-pair@30) that are
            there 15 ms later
    dark    light from 0.1 to 10,000 lux, sensors with the faults of real ones
    size    as dark, of cameras of one size: a pixel is the mean of 117 real ones, events have a real threshold of 0.2;
            controls are those of dark in the same folder
    bandwidth  as size, of events that need a tenth of the light for their bandwidth; frames are those of size
    shade   sensors as in dark, in the sun; what it does not reach is a hundred times darker; trained without and with
            cast shadows, flown in both; rooms have ceilings, so that with shadows all of them is in the shade; of the
            rooms of courtyards half have no roof, so that there are lit and dark ones; flown without the sun's shading
            in full light, and in a hundredth of the light with it, too
    turning the camera on the body, 64 x 48 pixels, at 8 and 12 m/s among trunks, in 50 to 500 lux
    fine    as turning, at 8 m/s among thin trunks and wires, with 64 x 48 and with 128 x 96 pixels; true depth is that
            of a ray through each pixel's middle, which passes by what is thinner than a pixel
    bytes   nothing is trained: the events of flights against frames, in bytes a second

    python benchmarks/worth.py --axis looks --out runs/worth -- --total-steps 20000000
    python benchmarks/worth.py --axis age --out runs/worth --sensors blind depth depth-late-1
    python benchmarks/worth.py --axis bytes --out runs/worth
    python benchmarks/worth.py --report --out runs/worth

A row is written when it is done, with the policies, and is not measured again; no row is begun that would not end in
time. Several processes may be given the same command, one a GPU: each takes rows that no other has. Arguments after --
are options of train.py; defaults are those of the hardware. --test-seed 46 is the final split, test worlds 46,000 to
46,999 for 1,000 missions: it was drawn once, for this map, and nothing may be chosen by it. Intervals are a bootstrap
over seeds and missions, 95 %, differences are of the same missions.
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import functools
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import success
from edqn_jax.devices.devices import most_that_divide, use_cpu_devices
from edqn_jax.devices.hardware import count_cores
from edqn_jax.files import check_can_make
from measurement.flags import split
from worth_parts import own, traffic
from worth_parts.axes import AXES, config_of, places_of
from worth_parts.flown import measure_row
from worth_parts.table import all_cells, tables

BYTES = "bytes"
MISSIONS = {BYTES: 32}
"""By axis, where it is not 1,000."""


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments; `flags` are those after --."""
    words, flags = split(argv)
    parser = Parser("worth", __doc__, json=None)
    parser.add_argument("--axis", choices=[*AXES, BYTES], help="whose rows are measured")
    parser.add_argument("--out", type=Path, required=True, help="folder of rows and policies")
    parser.add_argument("--worlds", nargs="+", help="of the axis (default all)")
    parser.add_argument("--trained", nargs="+", help="conditions of training (default all of the axis)")
    parser.add_argument("--sensors", nargs="+", help="(default all of the axis)")
    parser.add_argument("--seeds", type=at_least_one, default=5, help="training seeds, in one program (default 5)")
    parser.add_argument("--missions", type=at_least_one, help="in each condition (default 1000; 32 for bytes)")
    parser.add_argument("--test-seed", type=int, default=46, help="of the test worlds (default 46: the final split)")
    parser.add_argument("--minutes", type=float, default=9.0, help="begin no row that would end later (default 9)")
    parser.add_argument("--row-seconds", type=float, default=success.FIRST_ROW_S, help="of the first row (default 240)")
    parser.add_argument("--policy", default="pretrained-looks", help="that flies for bytes (default pretrained-looks)")
    parser.add_argument("--widths", nargs="+", type=at_least_one, default=list(traffic.SIZES), help="pixels, for bytes")
    parser.add_argument("--report", action="store_true", help="measure no row, print and draw those in --out")
    parser.add_argument("--figure", type=Path, help="PNG that --report draws (default worth.png in --out)")
    args = parser.parse(words)
    args.flags = flags
    if args.report == (args.axis is not None):
        parser.error("give either --axis, whose rows are measured, or --report")
    if not set(args.widths) <= set(traffic.SIZES):
        parser.error(f"--widths must be of {', '.join(map(str, traffic.SIZES))}")
    known = traffic.WORLDS if args.axis == BYTES else AXES[args.axis].worlds if args.axis else ()
    _choose(parser, args, "worlds", known)
    for name in ("trained", "sensors"):
        _choose(parser, args, name, getattr(AXES[args.axis], name) if args.axis in AXES else ())
    args.missions = args.missions or MISSIONS.get(args.axis, 1000)
    return args


def _choose(parser: argparse.ArgumentParser, args: argparse.Namespace, name: str, known: Sequence[str]) -> None:
    """Puts all that an axis has in the place of an argument that is left out; refuses what it has not."""
    given = getattr(args, name)
    if given is None:
        setattr(args, name, list(known))
    elif not set(given) <= set(known):
        has = ", ".join(known) or "nothing to choose"
        parser.error(f"--{name} must be of what the axis has ({has}), not {' '.join(sorted(set(given) - set(known)))}")


def wanted_rows(args: argparse.Namespace) -> list[success.Wanted]:
    """Returns the rows that the arguments ask for, and makes JAX present as many devices as they use.

    Raises:
        ConfigError: if an option is invalid.
    """
    wanted, axis = [], AXES[args.axis]
    for place in places_of(axis, args.worlds, args.trained, args.sensors):
        config = config_of(axis, place, args.flags)
        use_cpu_devices(most_that_divide(config.train.shards, count_cores()))
        identity = f"worth {args.axis} {place.trained} {args.seeds} {args.test_seed}"
        file = success.row_file(args.out, config, args.missions, identity)
        measure = functools.partial(measure_row, config, place, args, success.policies_of(file))
        wanted.append(success.Wanted(file, measure, says=_say))
    return wanted


def _say(row: success.Row) -> str:
    """Returns a row as a line of JSON with the success in each condition."""
    rates = {name: sum(one.count("1") for one in seeds) / sum(map(len, seeds)) for name, seeds in row["flown"].items()}
    return json.dumps({key: row[key] for key in ("axis", "world", "trained", "sensor")} | {"success": rates})


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0 when every row is there, 3 when rows are left for another call, 2 for invalid input."""
    began = time.perf_counter()
    args = parse(argv)
    check_can_make(args.out)
    own.register()
    if args.report:
        from worth_parts.picture import draw_map  # matplotlib is for the report alone

        rows = success.read_rows(args.out)
        cells = all_cells(rows)
        print(tables(rows, cells), flush=True)
        draw_map(rows, cells, args.figure or args.out / "worth.png")
        return 0
    wanted = traffic.wanted_rows(args) if args.axis == BYTES else wanted_rows(args)
    return 3 if success.measure(wanted, [], began + 60 * args.minutes, args.row_seconds) else 0


if __name__ == "__main__":
    sys.exit(main())
