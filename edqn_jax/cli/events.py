"""`edqn events`: what a file of events holds, how a policy sees it, and the same events in another form."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table
from tyro.conf import Positional, arg

from edqn_jax.cli.arguments import Point, check_is_saved, check_run, parse_arguments
from edqn_jax.cli.help import EVENTS
from edqn_jax.cli.process.status import show_phase
from edqn_jax.errors import ConfigError
from edqn_jax.files import check_can_write, write_atomically

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edqn_jax.config import Config
    from edqn_jax.interop.recordings.recording import Recording
    from edqn_jax.report.recordings import Strip


WINDOW_S = 0.05
"""Length of a window in pictures without a policy, seconds."""

LONG_PAUSE_S = 1.0
"""Longest time between two events that is not told, seconds."""


@dataclass(frozen=True)
class EventsArgs:
    """Say what a file of events holds; see it as a policy does; write it in another form."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """HDF5 in DSEC's layout (.h5, .hdf5), NumPy (.npz), text (.txt, .csv), or a camera's own file: .aedat4, .raw (EVT2,
    EVT3), .dat, .es."""
    size: Annotated[tuple[int, int] | None, arg(metavar="W H", help_behavior_hint="")] = None
    """Pixels across and down, where the file does not say (default: what the file says)."""
    time_unit: Annotated[Literal["s", "ms", "us", "ns"] | None, arg(help_behavior_hint="")] = None
    """Unit of the times, where the file does not say (default: the only plausible one)."""
    columns: Annotated[str | None, arg(metavar="t,x,y,p", help_behavior_hint="")] = None
    """Order of a text's columns, where no line names them (default: t,x,y,p, refused where another order fits)."""
    stream: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Which stream of events of an .aedat4 that has several, such as those of two cameras."""
    start: Annotated[float | None, arg(metavar="S", help_behavior_hint="")] = None
    """Leave out what is before this, seconds from the first event."""
    stop: Annotated[float | None, arg(metavar="S", help_behavior_hint="")] = None
    """Leave out what is from this on, seconds from the first event."""
    policy: Annotated[Path | None, arg(metavar="RUN", help_behavior_hint="")] = None
    """Run, or a policy of the package, at whose resolution and in whose windows the events are shown, and which encodes
    them."""
    contrast: Annotated[float | None, arg(metavar="C", help_behavior_hint="")] = None
    """Change of log brightness that makes an event in the camera (default: that of the policy)."""
    fov: Annotated[float | None, arg(metavar="DEG", help_behavior_hint="")] = None
    """The camera's horizontal field of view, degrees (default: its whole image is taken for the policy's)."""
    calibration: Annotated[str | None, arg(metavar="FILE[:CAMERA]", help_behavior_hint="")] = None
    """The camera's lens, in place of --fov: YAML of Kalibr or in DSEC's layout (of a camera other than cam0, with its
    name); events are taken to where their pixels look."""
    poses: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Where the camera was, on the events' clock: text, lines of t x y z qx qy qz qw (TUM's), or with named columns."""
    poses_of: Literal["camera", "body"] = "camera"
    """Whose poses: of the camera (z ahead, x to the right), or of a body (x ahead, z up) on which it looks ahead."""
    velocity: Annotated[Point, arg(metavar="X Y Z")] = (0.0, 0.0, 0.0)
    """Velocity ahead, to the left and up, m/s, where the file has no flight: the encoder reads events with it."""
    yaw_rate: Annotated[float, arg(metavar="R")] = 0.0
    """Yaw rate, rad/s to the left, likewise."""
    window: Annotated[float | None, arg(metavar="S", help_behavior_hint="")] = None
    """Length of a window in pictures in seconds (default: 0.05, a policy's own with --policy)."""
    picture: Annotated[Path | None, arg(metavar="FILE.png|gif", help_behavior_hint="")] = None
    """Also draw windows: six moments as a .png, or up to 120 as a .gif."""
    out: Annotated[Path | None, arg(metavar="FILE.h5|npz|txt", help_behavior_hint="")] = None
    """Also write the events, from --start to --stop."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write what was found as JSON."""


def parse_events(argv: Sequence[str]) -> EventsArgs:
    """Returns the checked arguments of `edqn events`.

    Raises:
        ConfigError: if one is out of its limits, or there is no such file or policy.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = parse_arguments(EventsArgs, argv, EVENTS)
    if args.file.is_dir():
        raise ConfigError(f"'{args.file}' is a folder; give a file of events")
    if not args.file.is_file():
        raise ConfigError(f"there is no file '{args.file}'")
    for name, number in (("--contrast", args.contrast), ("--window", args.window)):
        if number is not None and not number > 0.0:
            raise ConfigError(f"{name} must be above 0, not {number}")
    if args.window is not None and args.policy is not None:
        raise ConfigError("--window and --policy cannot both be given: a policy has a window of its own")
    if args.policy is None and (args.poses is not None or args.calibration is not None):
        raise ConfigError("--poses and --calibration are for what a policy sees; give --policy, too")
    if args.fov is not None and args.calibration is not None:
        raise ConfigError("--fov and --calibration cannot both be given: a calibration says the field of view")
    if args.picture is not None and args.picture.suffix.lower() not in (".png", ".gif"):
        raise ConfigError(f"'{args.picture}' must end in .png or .gif")
    if args.policy is not None:
        check_is_saved(args.policy, "--policy")
        check_run(args.policy)
    return args


def events_command(args: EventsArgs) -> None:
    """Runs `edqn events` with these arguments.

    Raises:
        ConfigError: if the file, the policy or a file to write is not as it should be.
        MissingPackageError: if the extra `events` is needed and not installed.
    """
    from edqn_jax.interop.recordings.event_files import check_can_write_events, read_events, write_events
    from edqn_jax.runs.directory import to_plain_json

    for file in (args.picture, args.json):
        if file is not None:
            check_can_write(file)
    if args.out is not None:
        check_can_write_events(args.out)
    show_phase("reading the events")
    whole = read_events(args.file, size=args.size, time_unit=args.time_unit, columns=args.columns, stream=args.stream)
    recording = whole.between(args.start, args.stop)
    figures: dict[str, Any] = {"file": str(args.file), **recording_figures(recording)}
    show_phase("looking at the events")
    strips, times_s, period_s = _strips(args, recording, figures)
    Console().print(recording_table(figures))
    if args.policy is not None:
        for note in _notes(args, recording, figures["seen"]):
            print(note)
    if args.picture is not None:
        show_phase("drawing")

        from edqn_jax.report.recordings import animate_recording, plot_recording

        if args.picture.suffix.lower() == ".gif":
            write_atomically(args.picture, animate_recording(strips, times_s, period_s))
        else:
            plot_recording(strips, times_s, args.picture)
    if args.out is not None:
        show_phase("writing the events")
        write_events(args.out, recording)
    if args.json is not None:
        write_atomically(args.json, json.dumps(to_plain_json(figures), indent=2, allow_nan=False) + "\n")


def recording_figures(recording: Recording) -> dict[str, Any]:
    """Returns what a recording holds, as figures."""
    events = recording.events
    known = recording.width is not None
    return {
        "events": len(events),
        "seconds": recording.seconds,
        "first_us": int(events["t"][0]),
        "events_per_second": len(events) / recording.seconds if recording.seconds else None,
        "on_share": float(np.mean(events["p"] > 0)),
        "width": recording.width if known else int(events["x"].max()) + 1,
        "height": recording.height if known else int(events["y"].max()) + 1,
        "size_is_known": known,
        "time_unit": recording.time_unit,
        "polarity": recording.polarity,
        "columns": recording.columns or None,
        "out_of_order": recording.out_of_order,
        "left_out": recording.left_out,
        "longest_pause_s": recording.longest_pause_s,
        "contrast": recording.contrast,
        "pictures": 0 if recording.pictures is None else len(recording.pictures.until_us),
        "has_flight": recording.flight is not None,
    }


def recording_table(figures: dict[str, Any]) -> Table:
    """Returns what a recording holds as a table for people."""
    table = Table(title=figures["file"], show_header=False, title_justify="left")
    table.add_column()
    table.add_column(justify="right")
    rate = figures["events_per_second"]
    table.add_row("events", f"{figures['events']:,}")
    table.add_row("duration", f"{figures['seconds']:.3f} s, from {figures['first_us'] * 1e-6:.6f} s")
    table.add_row("rate", "–" if rate is None else f"{rate:,.0f} events/s")
    table.add_row("ON events", f"{figures['on_share']:.1%}")
    size = f"{figures['width']} × {figures['height']} pixels"
    table.add_row("image", size if figures["size_is_known"] else f"at least {size}; the file does not say")
    table.add_row("unit of time in the file", figures["time_unit"])
    table.add_row("polarities in the file", figures["polarity"])
    if figures["columns"] is not None:
        table.add_row("columns in the file", figures["columns"])
    if figures["out_of_order"]:
        table.add_row("out of order, sorted", f"{figures['out_of_order']:,}")
    if figures["left_out"]:
        table.add_row("before the file's first time, left out", f"{figures['left_out']:,}")
    if figures["longest_pause_s"] > LONG_PAUSE_S:
        table.add_row("longest pause", f"{figures['longest_pause_s']:.3f} s without an event")
    if figures["contrast"] is not None:
        table.add_row("contrast per event", f"{figures['contrast']:g}")
    if figures["pictures"]:
        table.add_row("pictures", f"{figures['pictures']:,}")
    if figures["has_flight"]:
        table.add_row("poses of the camera", "yes")
    if "seen" in figures:
        seen = figures["seen"]
        table.add_row(f"as '{seen['policy']}' sees it", f"{seen['windows']} windows of {seen['window_s']:g} s")
    return table


def _strips(args: EventsArgs, recording: Recording, figures: dict[str, Any]) -> tuple[list[Strip], list[float], float]:
    """Returns what there is to draw, when, and how long a frame is to be shown."""
    if args.policy is None and args.picture is None:
        return [], [], 0.0
    from edqn_jax.interop.recordings.seen_events import image_at, observe_recording, window_ends
    from edqn_jax.runs.policies import load_policy

    begin = int(recording.events["t"][0])
    seen = None
    if args.policy is None:
        window_us = round(1e6 * (args.window or WINDOW_S))
        ends = window_ends(recording, window_us, window_us)
        period_s = window_us * 1e-6
    else:
        policy = load_policy(args.policy)
        placed = _with_poses(args, recording, policy.config)
        seen = observe_recording(
            policy,
            placed,
            contrast=args.contrast,
            fov_deg=args.fov,
            directions=_directions(args, recording),
            velocity=args.velocity,
            yaw_rate=args.yaw_rate,
        )
        times = policy.config.events.frame_times_s
        window_us, ends = round(1e6 * (times[-1] - times[0])), seen.until_us
        period_s = policy.config.drone.physics_steps * policy.config.drone.physics_dt_s
        figures["seen"] = {
            "policy": str(args.policy),
            "windows": len(ends),
            "window_s": window_us * 1e-6,
            "width": policy.config.camera.width,
            "height": policy.config.camera.height,
            "events_per_window": float(np.abs(seen.image).sum(axis=(1, 2)).mean()),
            **({} if placed.flight is None else motion_figures(placed.flight)),
        }
    if args.picture is None:
        return [], [], period_s

    from edqn_jax.report.images import EVENTS, NEARNESS, PHOTOGRAPH, RECONSTRUCTED_EVENTS
    from edqn_jax.report.recordings import MAX_FRAMES, MOMENTS, Strip, pick_windows

    most = MAX_FRAMES if args.picture.suffix.lower() == ".gif" else MOMENTS
    chosen = pick_windows(len(ends), most)
    width, height = recording.size()
    images = np.stack([image_at(recording, int(ends[number]), window_us) for number in chosen])
    strips = [Strip(f"camera,\n{width} × {height}", images, EVENTS)]
    if seen is not None:
        height, width = seen.image.shape[1:]
        strips.append(Strip(f"policy sees,\n{width} × {height}", seen.image[chosen], EVENTS))
        name, look = ("decoded nearness", NEARNESS) if seen.has_nearness else ("decoded events", RECONSTRUCTED_EVENTS)
        strips.append(Strip(name, seen.decoded[chosen], look))
    if recording.pictures is not None:
        taken = np.stack([recording.pictures.newest(int(ends[number])) for number in chosen])
        strips.append(Strip("camera's picture", taken, PHOTOGRAPH))
    return strips, [float(ends[number] - begin) * 1e-6 for number in chosen], period_s


def motion_figures(flight: Mapping[str, NDArray]) -> dict[str, float]:
    """Returns how fast a camera was on average, m/s, and how far from level, degrees."""
    w, x, y, z = flight["quaternion"].T
    tilt = np.degrees(np.arccos(np.clip(1 - 2 * (x * x + y * y), -1.0, 1.0)))
    return {
        "mean_speed_m_s": float(np.linalg.norm(flight["velocity"], axis=1).mean()),
        "mean_tilt_deg": float(tilt.mean()),
    }


def _notes(args: EventsArgs, recording: Recording, seen: Mapping[str, Any]) -> list[str]:
    """Returns a sentence for each thing that a policy must know: what it was told, or what was assumed."""
    notes = []
    if args.contrast is not None or recording.contrast is not None:
        told = f"{args.contrast:g}, as given" if args.contrast is not None else f"{recording.contrast:g}, of the file"
        notes.append(f"contrast: {told}")
    else:
        notes.append("contrast: that of the policy was assumed; --contrast gives the camera's")
    if args.calibration is not None:
        notes.append(f"lens: events were rectified by '{args.calibration}'")
    elif args.fov is not None:
        notes.append(f"lens: {args.fov:g} degrees across, as given, without distortion; --calibration gives its own")
    else:
        notes.append("field of view: the camera's whole image was taken for the policy's; --fov gives its own")
    if "mean_speed_m_s" in seen:
        whose = "that of the file" if args.poses is None else f"by '{args.poses}', poses of the {args.poses_of}"
        notes.append(
            f"own motion: {whose}, {seen['mean_speed_m_s']:.2f} m/s and {seen['mean_tilt_deg']:.0f} degrees from level "
            "on average; that z is up was assumed"
        )
    else:
        speed = " ".join(f"{each:g}" for each in args.velocity)
        notes.append(
            f"own motion: the encoder was told {speed} m/s and {args.yaw_rate:g} rad/s throughout; --poses, or "
            "--velocity and --yaw-rate give it, and without the right one its nearness is none"
        )
    return notes


def _with_poses(args: EventsArgs, recording: Recording, config: Config) -> Recording:
    """Returns the recording with the flight of --poses, if it is given."""
    if args.poses is None:
        return recording
    from edqn_jax.interop.recordings.poses import with_poses

    return with_poses(recording, args.poses, args.poses_of, config.env.speed_m_s)


def _directions(args: EventsArgs, recording: Recording) -> NDArray | None:
    """Returns where each pixel looks by --calibration, if it is given."""
    if args.calibration is None:
        return None
    from edqn_jax.interop.recordings.lens import read_lens

    lens = read_lens(args.calibration)
    lens.check_size(recording.size(), args.calibration)
    return lens.directions()
