"""`edqn export`: a policy as ONNX, compared with JAX, and the runner beside it."""

from __future__ import annotations

from rich.console import Console

from edqn_jax.cli.arguments import ExportArgs
from edqn_jax.interop.deployment.onnx_export import export_policy
from edqn_jax.runs.policies import load_policy, policy_digest


def export_command(args: ExportArgs) -> None:
    """Runs `edqn export` with these arguments.

    Raises:
        CheckError: if ONNX and JAX do not agree.
        ConfigError: if the run or the file to write is not as it should be.
    """
    exported = export_policy(load_policy(args.run), args.out, checks=args.checks, digest=policy_digest(args.run))
    ties = f", {exported.ties} of them ties" if exported.ties else ""
    Console().print(
        f"'{exported.file}' has {exported.file.stat().st_size / 1e6:.1f} MB; on {exported.checks:,} random inputs it "
        f"chooses JAX's moves{ties}, and no value differs by more than {exported.largest_difference:.1e} of the "
        f"largest; '{exported.runner}' flies it with NumPy and onnxruntime",
        soft_wrap=True,
        markup=False,
        highlight=False,
    )
