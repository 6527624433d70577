"""`--import`: what a file registers is known to the command, and a file that cannot be imported is named."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from edqn_jax.cli import main
from edqn_jax.cli.commands import take_imports
from edqn_jax.errors import ConfigError

SENSOR = """
import edqn_jax

edqn_jax.SENSORS.register("mine", edqn_jax.Sensor(lambda *_: ([], None), shape=lambda config: (3,)), "three numbers")
"""


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "edqn_jax", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_the_words_of_a_command_are_told_from_what_it_imports() -> None:
    words = ["train", "--import", "a.py", "--seed", "3", "--import=b", "--world", "mine"]
    assert take_imports(words) == (["train", "--seed", "3", "--world", "mine"], ["a.py", "b"])
    for words in (["train", "--import"], ["--import=", "train"]):
        with pytest.raises(ConfigError, match="--import must be followed by a Python file or the name of a module"):
            take_imports(words)


@pytest.mark.whole
def test_help_lists_what_a_file_or_a_module_registers_and_a_run_takes_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own.py").write_text(SENSOR)
    done = run(tmp_path, "train", "--import", "own.py", "--help-all")
    assert done.returncode == 0 and "`mine`: three numbers" in " ".join(done.stdout.replace("│", " ").split())
    words = ("train", "--env.sensor", "mine", "--train.num-envs", "0")
    assert "train.num_envs must be at least 1" in run(tmp_path, "--import", "own", *words).stderr
    assert main(words[:3]) == 2 and "there is no sensor 'mine'" in capsys.readouterr().err


NOT_IMPORTED = {
    "nowhere.py": (None, "there is no file 'nowhere.py'"),
    "nowhere": (None, "there is no module 'nowhere'; give a file"),
    "twice.py": (
        2 * SENSOR,
        "'twice.py' does not load: the sensor 'mine' is there already; give yours another name, l",
    ),
    "fails.py": ("raise ValueError('two\\nlines')", "'fails.py' does not load: ValueError: two\\nlines, line 1"),
    # Once JAX has computed in the process, the others would be named for it.
    "early.py": ("import jax.numpy as jnp\njnp.zeros(3)", "'early.py' computes with JAX while it is imported"),
}
"""Text of each file, and what is said of it."""


@pytest.mark.whole
def test_what_cannot_be_imported_is_named(tmp_path: Path) -> None:
    for name, (text, _) in NOT_IMPORTED.items():
        if text is not None:
            (tmp_path / name).write_text(text)
    script = """
import contextlib, io, json, sys
from edqn_jax.cli import main
for name in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = main(["evaluate", "pretrained", "--import", name])
    print(json.dumps([code, said.getvalue()]))
"""
    command = [sys.executable, "-c", script, json.dumps(list(NOT_IMPORTED))]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    for line, (_, says) in zip(done.stdout.splitlines(), NOT_IMPORTED.values(), strict=True):
        code, said = json.loads(line)
        *phases, last = said.splitlines()
        assert code == 2 and says in last, said
        assert all(phase.startswith(("edqn evaluate: ", "  starting")) for phase in phases)
