"""What tests share stands in `tests/support`, and slow, plain versions in `tests/oracles`."""

from __future__ import annotations

import ast
import re
import types
from pathlib import Path

import pytest

from tests import conftest

ROOT = Path(__file__).parents[1]
SHARED = ("tests.conftest", "tests.support", "tests.oracles", "tests.mutants", "tests.fuzz")
"""What test modules may import of `tests`; the last two are programs of their own."""
PROCESS = re.compile(r"^import .*\n(?:.*\n)*?from tests\.", re.MULTILINE)
"""In a string: the source of a process."""
FILES = sorted((ROOT / "tests").rglob("*.py"))


def unshared(source: str) -> list[str]:
    """Returns the modules of `tests` that a source imports though they are not shared."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and PROCESS.search(node.value):
            names = unshared(node.value)
        else:
            continue
        inside = [name for name in names if name.split(".")[0] == "tests"]
        found += [name for name in inside if not name.startswith(SHARED) or ".test_" in name]
    return found


@pytest.mark.parametrize("file", FILES, ids=[str(file.relative_to(ROOT)) for file in FILES])
def test_no_module_imports_a_test_module(file: Path) -> None:
    assert unshared(file.read_text(encoding="utf-8")) == []


def test_what_is_not_shared_is_found_wherever_it_is_imported() -> None:
    assert unshared("from tests.support.policies import CONFIG\nfrom tests import conftest\nimport jax") == []
    assert unshared("def f():\n    from tests.learn.test_dqn import PLAIN") == ["tests.learn.test_dqn.PLAIN"]
    assert unshared("from tests.learn import test_dqn") == ["tests.learn.test_dqn"]
    assert unshared("import tests.whole.helpers") == ["tests.whole.helpers"]
    process = "import sys\n" + "from tests.sim.test_a import b"
    assert unshared(f"CODE = {process!r}") == ["tests.sim.test_a.b"]


SOURCES = pytest.Config.ArgsSource


@pytest.mark.parametrize(
    ("source", "given", "then"),
    [
        (SOURCES.TESTPATHS, {}, "not whole"),
        (SOURCES.TESTPATHS, {"markexpr": "whole"}, "whole"),
        (SOURCES.TESTPATHS, {"markexpr": "not slow"}, "not slow"),
        (SOURCES.TESTPATHS, {"keyword": "trainer"}, ""),
        (SOURCES.ARGS, {}, ""),
    ],
)
def test_tests_of_whole_policies_are_left_out_where_none_is_named(source, given: dict[str, str], then: str) -> None:
    option = types.SimpleNamespace(**{"markexpr": "", "keyword": ""} | given)
    # Workers choose for themselves: they are given the words of the command, and none of what was decided.
    config = types.SimpleNamespace(args_source=source, ArgsSource=SOURCES, option=option, workerinput={})
    conftest.pytest_configure(config)  # pyright: ignore[reportArgumentType]
    assert option.markexpr == then
