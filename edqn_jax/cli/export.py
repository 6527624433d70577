"""`edqn export`: a policy as ONNX, compared with JAX, and the runner beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from edqn_jax.cli.arguments import check_is_saved, check_run, parse_arguments
from edqn_jax.cli.help import EXPORT
from edqn_jax.cli.process.status import show_phase
from edqn_jax.errors import ConfigError


@dataclass(frozen=True)
class ExportArgs:
    """Write a policy as ONNX, for a computer without JAX, and beside it the runner that flies it; compare both."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of the run, or a policy of the package: `pretrained`, `pretrained-looks`, `pretrained-late` or
    `pretrained-body`."""
    out: Annotated[Path, arg(metavar="FILE.onnx")]
    """File to write; it replaces one of that name."""
    checks: Annotated[int, arg(metavar="N")] = 1000
    """Random inputs on which ONNX and JAX must choose the same moves, with values that agree to 1e-5 of the largest."""


def parse_export(argv: Sequence[str]) -> ExportArgs:
    """Returns the checked arguments of `edqn export`.

    Raises:
        ConfigError: if one is out of its limits, or there is no such run.
        SystemExit: after printing, for --help and for what does not parse.
    """
    args = parse_arguments(ExportArgs, argv, EXPORT)
    if args.checks < 1000:
        raise ConfigError(f"--checks must be at least 1000, not {args.checks}")
    if args.out.suffix.lower() != ".onnx":
        raise ConfigError(f"--out '{args.out}' must end in .onnx")
    check_is_saved(args.run, EXPORT)
    check_run(args.run)
    return args


def export_command(args: ExportArgs) -> None:
    """Runs `edqn export` with these arguments.

    Raises:
        CheckError: if ONNX and JAX do not agree.
        ConfigError: if the run or the file to write is not as it should be.
    """
    show_phase("exporting and comparing with JAX")

    from edqn_jax.interop.deployment.onnx_export import export_policy
    from edqn_jax.runs.policies import load_policy, policy_digest

    exported = export_policy(load_policy(args.run), args.out, checks=args.checks, digest=policy_digest(args.run))
    compared = exported.checks - exported.on_edges
    left_out = f" ({exported.on_edges} more, with counts at the edge of being rounded otherwise, were left out)"
    ties = f", {exported.ties} of them ties" if exported.ties else ""
    print(
        f"'{exported.file}' has {exported.file.stat().st_size / 1e6:.1f} MB; on {compared:,} random inputs"
        f"{left_out if exported.on_edges else ''} it chooses JAX's moves{ties}, and no value differs by more than "
        f"{exported.largest_difference:.1e} of the largest; '{exported.runner}' flies it with NumPy and onnxruntime",
    )
