"""Deliberate bugs of `mutants.toml`: read, found in the code and put into it.

A mutant of Python code is found by the function that it is in and by the code that it changes, compared as syntax; so
it stays true when files move and when code is formatted anew. One of C is found by its text, whatever the white space.
Its tests are found by the names of file and function.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

LIST = Path(__file__).with_name("mutants.toml")

NATIVE = (".c", ".h", ".cu")
"""Suffixes of files that are searched as text."""


class MutantError(Exception):
    """The list or the tests cannot be used; the message says why."""


@dataclasses.dataclass(frozen=True)
class Mutant:
    """One deliberate bug."""

    name: str
    says: str
    """What is broken."""
    place: str
    """Qualified name of the function or class that it is in, such as `Replay.write`; of C code the name of the file."""
    find: str
    """An expression or statements, which the place holds exactly once."""
    replace: str
    tests: tuple[str, ...]
    """Test functions, of which at least one must fail, as `test_env::test_it_flies`."""


@dataclasses.dataclass(frozen=True)
class Bug:
    """A mutant in the text of a file."""

    file: str
    """Path in the repository."""
    text: str
    """Of the file with the bug in it."""


def load_mutants() -> list[Mutant]:
    """Returns the mutants of the list, in its order."""
    content = tomllib.loads(LIST.read_text(encoding="utf-8"))
    return [
        Mutant(name, *(fields[key].strip() for key in ("says", "in", "find", "replace")), tests=tuple(fields["test"]))
        for name, fields in content.items()
    ]


def put_into(mutant: Mutant, root: Path) -> Bug:
    """Returns the file of the package under `root` that the mutant changes, with the bug in it.

    Raises:
        MutantError: if what it looks for is not there exactly once.
    """
    found = list(_in_native(mutant, root) if mutant.place.endswith(NATIVE) else _in_python(mutant, root))
    if len(found) != 1:
        raise MutantError(f"what '{mutant.name}' looks for is {len(found)} times in '{mutant.place}'; it must be once")
    return found[0]


def find_test(test: str, root: Path) -> str:
    """Returns pytest's node id, under `root`, of a test named by file and function, as `test_env::test_flies`.

    Raises:
        MutantError: if there is not exactly one such test.
    """
    name, _, function = test.partition("::")
    defined = re.compile(rf"^def {function}\(", re.MULTILINE)
    files = [file for file, text in _texts(root / "tests", f"{name}.py").items() if defined.search(text)]
    if len(files) != 1:
        raise MutantError(f"there are {len(files)} tests '{test}'; there must be one")
    return f"{files[0].relative_to(root)}::{function}"


def _in_native(mutant: Mutant, root: Path) -> Iterator[Bug]:
    pattern = re.compile(r"\s+".join(re.escape(word) for word in mutant.find.split()))
    for file, text in _texts(root / "edqn_jax", mutant.place).items():
        for match in pattern.finditer(text):
            yield Bug(str(file.relative_to(root)), text[: match.start()] + mutant.replace + text[match.end() :])


def _in_python(mutant: Mutant, root: Path) -> Iterator[Bug]:
    """Yields the bug for each place where the mutant fits."""
    last = mutant.place.rpartition(".")[2]
    wanted = ast.parse(mutant.find).body
    for file, text in _texts(root / "edqn_jax", "*.py").items():
        if f"def {last}" not in text and f"class {last}" not in text:
            continue
        for scope in _scopes(ast.parse(text), mutant.place):
            for first, end in _occurrences(scope, wanted):
                yield Bug(str(file.relative_to(root)), _with(text, first, end, mutant.replace))


def _scopes(tree: ast.AST, place: str, outer: str = "") -> Iterator[ast.AST]:
    """Yields the functions and classes of this qualified name, which leaves out `<locals>`."""
    for node in ast.iter_child_nodes(tree):
        name = outer
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            name = f"{outer}.{node.name}".lstrip(".")
            if name == place:
                yield node
        yield from _scopes(node, place, name)


def _occurrences(scope: ast.AST, wanted: list[ast.stmt]) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Yields first and last node of each place in `scope` that is the wanted expression, or the wanted statements."""
    if len(wanted) == 1 and isinstance(wanted[0], ast.Expr):
        as_text = ast.dump(wanted[0].value)
        yield from (
            (node, node) for node in ast.walk(scope) if isinstance(node, ast.expr) and ast.dump(node) == as_text
        )
        return
    as_texts = [ast.dump(statement) for statement in wanted]
    for node in ast.walk(scope):
        for block in (getattr(node, name, None) for name in ("body", "orelse", "finalbody")):
            if isinstance(block, list):
                written = [ast.dump(statement) for statement in block]
                for start in range(len(block) - len(wanted) + 1):
                    if written[start : start + len(wanted)] == as_texts:
                        yield block[start], block[start + len(wanted) - 1]


def _with(text: str, first: ast.AST, last: ast.AST, replace: str) -> str:
    """Returns the text with other code from the node `first` to the node `last`."""
    assert isinstance(first, ast.expr | ast.stmt) and isinstance(last, ast.expr | ast.stmt)
    assert last.end_lineno is not None and last.end_col_offset is not None
    lines = text.encode().splitlines(keepends=True)
    before = b"".join(lines[: first.lineno - 1]) + lines[first.lineno - 1][: first.col_offset]
    after = lines[last.end_lineno - 1][last.end_col_offset :] + b"".join(lines[last.end_lineno :])
    if isinstance(first, ast.expr):
        return (before + f"({replace})".encode() + after).decode()
    return (before + replace.replace("\n", "\n" + " " * first.col_offset).encode() + after).decode()


@functools.cache
def _texts(folder: Path, pattern: str) -> dict[Path, str]:
    return {file: file.read_text(encoding="utf-8") for file in sorted(folder.rglob(pattern))}
