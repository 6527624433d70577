"""Modules of users: found by path or name, executed once, and named with the line that fails."""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.user_code import load_module


@pytest.fixture(autouse=True)
def modules_and_path() -> Iterator[None]:
    modules, path = dict(sys.modules), list(sys.path)
    yield
    for name in sys.modules.keys() - modules.keys():
        del sys.modules[name]
    sys.path[:] = path


def written(file: Path, text: str) -> str:
    file.parent.mkdir(exist_ok=True)
    file.write_text(text)
    return str(file)


def test_a_file_is_the_one_of_its_path_whatever_it_is_called(tmp_path: Path) -> None:
    mine = written(tmp_path / "random.py", "who = 'mine'")
    assert load_module(mine).who == "mine" and sys.modules["random"] is random
    one, other = (written(tmp_path / folder / "same_name_of_two.py", f"who = '{folder}'") for folder in ("a", "b"))
    assert (load_module(one).who, load_module(other).who) == ("a", "b")
    assert load_module(written(tmp_path / "with.a-dot.py", "who = 'dotted'")).who == "dotted"


def test_a_file_is_executed_once_also_where_another_imports_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TIMES", "")
    one = written(tmp_path / "counts_itself.py", "import os\n\nos.environ['TIMES'] += 'x'")
    other = written(tmp_path / "imports_that.py", "import counts_itself")
    assert load_module(one) is load_module(one) is load_module(other).counts_itself
    assert os.environ["TIMES"] == "x"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x = 1\ny = x / 0\n", r"does not load: ZeroDivisionError: division by zero, line 2$"),
        ("def f(:\n", r"does not load: SyntaxError: .*line 1\)$"),
        ("import no_such_thing\n", r"does not load: ModuleNotFoundError: No module named 'no_such_thing', line 1$"),
        ("raise SystemExit('never')\n", r"does not load: SystemExit: never, line 1$"),
        ("import json\n\njson.loads('')\n", r"does not load: JSONDecodeError: .*, line 3$"),
    ],
)
def test_what_does_not_load_is_named_with_the_users_line(text: str, says: str, tmp_path: Path) -> None:
    file = written(tmp_path / "fails_to_load.py", text)
    for _ in range(2):  # the second time, too
        with pytest.raises(ConfigError, match=says):
            load_module(file)


def test_a_module_that_is_there_and_misses_another_is_not_said_to_be_missing(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "no_such_thing_of_mine.py", "import no_such")
    with pytest.raises(ConfigError, match="'no_such_thing_of_mine' does not load: .* No module named 'no_such'"):
        load_module("no_such_thing_of_mine")
    for name in ("no_such", "no_such.part", "json.no_such"):
        with pytest.raises(ConfigError, match=f"there is no module '{name}'"):
            load_module(name)
