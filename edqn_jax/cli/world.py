"""`edqn world`: a world of a scan, a mesh or a cloud of points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from edqn_jax.cli.arguments import Point, parse_arguments
from edqn_jax.cli.help import WORLD
from edqn_jax.cli.process.status import show_phase
from edqn_jax.errors import ConfigError
from edqn_jax.files import check_can_make, write_atomically

MJCF_NAME = "world.xml"
"""Of the file that is flown."""


@dataclass(frozen=True)
class WorldArgs:
    """Make a world of a scan: an MJCF file, and the mesh that it names."""

    scan: Annotated[Positional[Path], arg(metavar="FILE")]
    """A mesh or a cloud of points, a .ply, .obj, .stl or .glb, points alone, an .xyz or .pcd, or an OctoMap, a .bt."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for the world, a new one."""
    scale: Annotated[float, arg(metavar="M")] = 1.0
    """Metres of a unit of the file: 0.001 if it is in millimetres."""
    up: Annotated[str | None, arg(metavar="AXIS", help_behavior_hint="")] = None
    """Axis of the file that points up: x, y or z, or --up=-x, --up=-y or --up=-z (default: y of .glb, z of the
    others)."""
    thickness: Annotated[float | None, arg(metavar="M", help_behavior_hint="")] = None
    """Thickness of the surface of a mesh that is not closed, or of points, metres (default: a mesh must be closed;
    points 0.1)."""
    start: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Start, metres in the world, whose corner is at 0 0 0 (default: a free place far from the goal)."""
    goal: Annotated[Point | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Goal, metres (default: a free place far from the start)."""


def parse_world(argv: Sequence[str]) -> WorldArgs:
    """Returns the checked arguments of `edqn world`.

    Raises:
        ConfigError: if one is not as it should be.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = parse_arguments(WorldArgs, argv, WORLD)
    if not 0 < args.scale < float("inf"):
        raise ConfigError(f"--scale must be above 0 and finite, not {args.scale:g}")
    if args.thickness is not None and not 0 < args.thickness <= 1:
        raise ConfigError(f"--thickness must be above 0, to 1 m, not {args.thickness:g}")
    ups = ("x", "y", "z", "-x", "-y", "-z")
    if args.up is not None and args.up not in ups:
        raise ConfigError(f"--up '{args.up}' is no axis; give --up={', --up='.join(ups)}")
    if args.out.exists() and (not args.out.is_dir() or any(args.out.iterdir())):
        raise ConfigError(f"--out '{args.out}' exists and is not empty; name a new folder")
    return args


def world_command(args: WorldArgs) -> None:
    """Runs `edqn world` with these arguments.

    Raises:
        ConfigError: if the scan cannot be a world, or the folder cannot be written.
    """
    from edqn_jax.config import Config
    from edqn_jax.sim.scene.scans.scan import NAME, ScanOptions, read_scan, world_of_scan

    check_can_make(args.out)
    options = ScanOptions(args.scale, args.up, args.thickness, args.start, args.goal)
    show_phase("reading the scan")
    scan = read_scan(args.scan, options)
    show_phase("making the world")
    mjcf, mesh, grid = world_of_scan(scan, options, Config().drone.body_radius_m)
    args.out.mkdir(parents=True, exist_ok=True)
    write_atomically(args.out / f"{NAME}.obj", mesh)
    write_atomically(args.out / MJCF_NAME, mjcf)
    size = " × ".join(f"{2 * half:.1f}" for half in grid.half)
    thick = f", {scan.thickness:g} m thick" if scan.thickness else ""
    print(f"{args.out / MJCF_NAME}: {scan.was}{thick}, {size} m, distances on cells of {grid.cell:g} m")
    print(f"look at it:  python -m mujoco.viewer --mjcf={args.out / MJCF_NAME}")
    print(f"check it:    edqn check {args.out / MJCF_NAME} --out {args.out / 'world.png'}")
