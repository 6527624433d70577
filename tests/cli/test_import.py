"""`--import`: what a file registers is known to the command, and a file that cannot be imported is named."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

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


def test_help_lists_what_a_file_or_a_module_registers_and_a_run_takes_it(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(SENSOR)
    done = run(tmp_path, "train", "--import", "own.py", "--help-all")
    assert done.returncode == 0 and "`mine`: three numbers" in " ".join(done.stdout.replace("│", " ").split())
    words = ("train", "--env.sensor", "mine", "--train.num-envs", "0")
    assert "train.num_envs must be at least 1" in run(tmp_path, "--import", "own", *words).stderr
    assert "there is no sensor 'mine'" in run(tmp_path, *words[:3]).stderr


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("nowhere.py", None, "there is no file 'nowhere.py'"),
        pytest.param("nowhere", None, "there is no module 'nowhere'; give a file", marks=pytest.mark.whole),
        ("early.py", "import jax.numpy as jnp\njnp.zeros(3)", "'early.py' computes with JAX while it is imported"),
        pytest.param(
            "twice.py",
            2 * SENSOR,
            "'twice.py' does not load: the sensor 'mine' is there already; give yours another name, l",
            marks=pytest.mark.whole,
        ),
        ("fails.py", "raise ValueError('two\\nlines')", "'fails.py' does not load: ValueError: two\\nlines, line 1"),
    ],
)
def test_what_cannot_be_imported_is_named(tmp_path: Path, name: str, text: str | None, says: str) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    done = run(tmp_path, "evaluate", "pretrained", "--import", name)
    *phases, said = done.stderr.splitlines()
    assert (
        done.returncode == 2
        and says in said
        and all(line.startswith(("edqn evaluate: ", "  starting")) for line in phases)
    )
