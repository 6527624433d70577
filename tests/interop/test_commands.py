"""The shell blocks of all pages are scripts, and each command in them parses by the parser of the real command."""

from __future__ import annotations

import ast
import importlib
import re
import shlex
import subprocess
import tomllib
from pathlib import Path

import pytest

from edqn_jax.cli import evaluate, events, export, fly, record, report, world
from edqn_jax.cli.arguments import check_flags
from edqn_jax.cli.commands import take_imports
from edqn_jax.cli.help import VERIFY
from edqn_jax.cli.train import parse_train
from tests.support.pages import PAGES, ROOT, SHELL, blocks_of, empty_module, name_of
from tests.support.registries import keep_as_they_are

EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]

BLOCKS = [(name_of(page), code) for page in PAGES for code in blocks_of(page, *SHELL)]

RUNS = ("edqn evaluate", "edqn record", "edqn report", "edqn verify", "edqn export", "edqn events", "edqn fly")

PARSERS = {
    "evaluate": evaluate.parse_evaluate,
    "record": record.parse_record,
    "report": report.parse_report,
    "export": export.parse_export,
    "world": world.parse_world,
    "fly": fly.parse_fly,
}


def commands(code: str) -> list[list[str]]:
    """Returns the words of each command of a script; its variables are 1."""
    code = re.sub(r"\$\{?\w+\}?", "1", code).replace("\\\n", " ")
    found = []
    for line in code.splitlines():
        words = shlex.split(line, comments=True)
        for part in " ".join(map(shlex.quote, words)).replace("'&&'", "&&").replace("'&'", "").split(" && "):
            found.append(shlex.split(part))
    return [[word.removeprefix(".venv/bin/") for word in words] for words in found if words]


def what_registers(code: str) -> str:
    """Returns an example up to the statement that registers something: what it trains is another test's to run."""
    statements = ast.parse(code).body
    last = max(number for number, part in enumerate(statements) if ".register(" in ast.unparse(part))
    return "\n".join(map(ast.unparse, statements[: last + 1]))


COMMANDS = [(page, words) for page, code in BLOCKS for words in commands(code)]


@pytest.mark.parametrize(("page", "code"), BLOCKS, ids=[page for page, _ in BLOCKS])
def test_a_shell_block_is_a_script(page: str, code: str) -> None:
    subprocess.run(["bash", "-n"], input=code, text=True, check=True)


@pytest.mark.parametrize(("page", "words"), COMMANDS, ids=[f"{page}: {' '.join(words)}" for page, words in COMMANDS])
def test_a_command_parses(page: str, words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for command in (evaluate, record, report, export, events, fly):
        monkeypatch.setattr(command, "check_run", lambda folder: None)  # runs/DIR is a reader's
    words, imported = take_imports(words)
    if imported:  # the page has what the file registers
        keep_as_they_are(monkeypatch)
        found = [code for code in blocks_of(ROOT / page, "python") if ".register(" in code]
        code = next((code for code in found if any(f'register("{word}"' in code for word in words)), found[0])
        exec(what_registers(code), empty_module("imported_by_a_command", monkeypatch))
    if "train.py" in words or words[:2] == ["edqn", "train"]:
        parse_train(words[words.index("train.py" if "train.py" in words else "train") + 1 :])
    elif words[0] == "edqn" and words[1] in PARSERS:
        PARSERS[words[1]](words[2:])
    elif words[:2] == ["edqn", "events"]:
        monkeypatch.setattr(Path, "is_file", lambda self: True)  # a reader's, too
        events.parse_events(words[2:])
    elif words[:2] == ["edqn", "verify"]:
        check_flags(words[2:], {"--json"}, VERIFY)
    elif words[0] == "python" and words[1].startswith("benchmarks/"):
        assert (ROOT / words[1]).is_file()
        module = importlib.import_module(Path(words[1]).stem)
        if hasattr(module, "parse"):
            module.parse(words[2:])
    elif "pip" in words:
        for asked in re.findall(r"\[([\w,]+)\]", " ".join(words)):
            assert set(asked.split(",")) <= set(EXTRAS)


def test_there_are_commands_of_every_kind() -> None:
    joined = [" ".join(words) for _, words in COMMANDS]
    for kind in ("python train.py", *RUNS, "python benchmarks/", "pip install"):
        assert any(kind in command for command in joined), kind
