"""`edqn completion`: what a shell needs to complete commands, options and their values."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg

from edqn_jax.cli.arguments import parse_arguments
from edqn_jax.cli.evaluate import EvaluateArgs
from edqn_jax.cli.help import COMPLETION, NAMED, all_of_train, with_conditions, with_help_texts
from edqn_jax.cli.record import RecordArgs
from edqn_jax.cli.train import SHORT_NAMES, TrainOptions
from edqn_jax.config import CONDITIONS
from edqn_jax.config.loading import make_config

FILES_TOO = {
    "bash": {
        "complete -F": "complete -o bashdefault -o default -F",
        'COMPREPLY=("${matches[@]}")': '[[ -n "$completions" ]] && COMPREPLY=("${matches[@]}")',
    },
    "zsh": {"  _describe ": '  [[ -n "$completions" ]] || { _files; return; }\n  _describe '},
    "fish": {"complete --no-files": "complete"},
}
"""What is replaced in tyro's scripts so that a shell offers files, such as runs and worlds, where nothing else fits."""


@dataclass(frozen=True)
class CompletionArgs:
    """Print a script that completes commands, options and their values in a shell."""

    shell: Annotated[Positional[Literal["bash", "zsh", "fish"]], arg(metavar="SHELL")]
    """`bash`, `zsh` or `fish`."""


def parse_completion(argv: Sequence[str]) -> CompletionArgs:
    """Returns the arguments of `edqn completion`.

    Raises:
        ConfigError: if there is no such flag.
        SystemExit: after printing, for --help and for what does not parse.
    """
    return parse_arguments(CompletionArgs, argv, COMPLETION)


def completion_script(shell: Literal["bash", "zsh", "fish"], kinds: Mapping[str, type]) -> str:
    """Returns the script that completes `edqn` in a shell.

    Args:
        shell: for which.
        kinds: the dataclass of each command's options.
    """
    names: dict[str, Any] = {option: Literal[tuple(choices)] for option, choices in NAMED.items()}
    worlds: Any = Literal[("paper", *NAMED["world"])]  # those that have a name; others are files
    names |= dict.fromkeys(("world", "world.name", "world.flown"), worlds)
    somewhere = Path()
    in_a_world = {
        "evaluate": EvaluateArgs(somewhere, "paper"),
        "record": RecordArgs(somewhere, somewhere, world="paper"),
    }
    commands = {
        name: with_help_texts(kind, in_a_world.get(name), kinds=names if name in in_a_world else None)
        for name, kind in kinds.items()
        if name != "train"
    }
    commands["evaluate"] = with_conditions(commands["evaluate"], CONDITIONS)
    commands = {"train": all_of_train(TrainOptions(), make_config(), SHORT_NAMES, names), **commands}
    written = io.StringIO()
    with contextlib.redirect_stdout(written), contextlib.suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(commands, prog="edqn", args=["--tyro-print-completion", shell])
    script = written.getvalue()
    for found, better in FILES_TOO[shell].items():
        script = script.replace(found, better)
    return script
