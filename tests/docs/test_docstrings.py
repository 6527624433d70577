"""Docstrings: what is public has one, and what takes or returns arrays says in which shape.

The rule, by the source alone. Public is each function, method and class of a public module of the package whose
name has no leading underscore. One *has arrays* if an annotation of its arguments or its result is `Array`,
`ArrayLike` or an array of NumPy; an argument that is a random key does not count. It *names a shape* if its docstring
has one in brackets: `[]`, `[3]`, `[..., H, W]`. It *has quantities* if an array among its arguments is named after one,
such as a position or a time, and *names a unit* if its docstring has one. Examples in docstrings are run.
"""

from __future__ import annotations

import ast
import doctest
import functools
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "edqn_jax"

ARRAY = re.compile(r"\b(Array|ArrayLike|NDArray|ndarray)\b(?!\])")

SHAPE = re.compile(r"\[[^\]\n]*\]")

QUANTITY = re.compile(
    r"(position|velocity|speed|distance|clearance|depth|nearness|time|angle|yaw|heading|rate|torque|thrust|start|goal|point"
    r"|origin|radius|height|length|path|seconds|acceleration|displacement|offset)s?$"
)
"""Ends of names of arguments that have a unit, or need the word that they have none."""

UNIT = re.compile(
    r"\b(metres?|m|m/s|m/s²|s|(milli|micro|nano)?seconds?|ms|rad|radians?|rad/s|degrees?|Hz|newtons?|N m|kg|bytes"
    r"|pixels?|decisions?|steps|units?)\b"
)

LEAST = 0.95
"""Share that the project asks for."""

Public = ast.FunctionDef | ast.ClassDef


def public(body: list[ast.stmt], prefix: str) -> Iterator[tuple[str, Public]]:
    """Yields each public function, class and method with its name."""
    for node in body:
        if isinstance(node, Public) and not node.name.startswith("_"):
            yield f"{prefix}.{node.name}", node
            if isinstance(node, ast.ClassDef):
                yield from public(node.body, f"{prefix}.{node.name}")


@functools.cache
def everything() -> list[tuple[str, Public]]:
    found = []
    for file in sorted(PACKAGE.rglob("*.py")):
        module = ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts)
        if not file.stem.startswith("_") or file.stem == "__init__":
            found += public(ast.parse(file.read_text(encoding="utf-8")).body, module)
    return found


def arrays_of(node: Public) -> list[str]:
    """Returns the names of the arguments that are arrays, and `return` if the result is one."""
    if not isinstance(node, ast.FunctionDef):
        return []
    arguments = [(a.arg, a.annotation) for a in (*node.args.args, *node.args.kwonlyargs) if "key" not in a.arg]
    named = [*arguments, ("return", node.returns)]
    return [name for name, annotation in named if annotation is not None and ARRAY.search(ast.unparse(annotation))]


def test_public_names_have_docstrings() -> None:
    names = everything()
    without = [name for name, node in names if not ast.get_docstring(node)]
    assert len(without) <= (1 - LEAST) * len(names), without


def unknown_arguments(node: ast.FunctionDef) -> set[str]:
    """Returns the names that the section `Args:` of a docstring explains and the function does not have."""
    _, _, section = (ast.get_docstring(node) or "").partition("Args:\n")
    section = re.split(r"\n(?=\S)", section)[0]
    explained = re.findall(r"^    (\w+(?:, \w+)*):", section, re.MULTILINE)
    args = node.args
    known = {arg.arg for arg in (*args.posonlyargs, *args.args, *args.kwonlyargs, args.vararg, args.kwarg) if arg}
    return {name for names in explained for name in names.split(", ")} - known


def test_arguments_that_docstrings_explain_are_there() -> None:
    functions = [(name, node) for name, node in everything() if isinstance(node, ast.FunctionDef)]
    assert sum("Args:\n" in (ast.get_docstring(node) or "") for _, node in functions) > 100
    assert {name: found for name, node in functions if (found := unknown_arguments(node))} == {}
    told = 'def f(a, *, b):\n    """Returns 1.\n\n    Args:\n        a: one.\n        c: none.\n    """'
    (wrong,) = ast.parse(told).body
    assert isinstance(wrong, ast.FunctionDef)
    assert unknown_arguments(wrong) == {"c"}


def test_functions_of_arrays_name_their_shapes() -> None:
    of_arrays = [(name, ast.get_docstring(node) or "") for name, node in everything() if arrays_of(node)]
    without = [name for name, text in of_arrays if not SHAPE.search(text)]
    assert len(of_arrays) > 200
    assert len(without) <= (1 - LEAST) * len(of_arrays), (len(without), len(of_arrays), without)


def test_functions_of_quantities_name_their_units() -> None:
    of_quantities = [
        (name, ast.get_docstring(node) or "")
        for name, node in everything()
        if any(QUANTITY.search(argument) for argument in arrays_of(node))
    ]
    without = [name for name, text in of_quantities if not UNIT.search(text)]
    assert len(of_quantities) > 60
    assert len(without) <= (1 - LEAST) * len(of_quantities), (len(without), len(of_quantities), without)


WITH_EXAMPLES = [file for file in sorted(PACKAGE.rglob("*.py")) if ">>> " in file.read_text(encoding="utf-8")]


@pytest.mark.parametrize("file", WITH_EXAMPLES, ids=lambda file: file.stem)
def test_the_examples_of_docstrings_are_true(file: Path) -> None:
    module = importlib.import_module(".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts))
    failed, tried = doctest.testmod(module)
    assert tried > 0 and failed == 0


def test_there_are_examples() -> None:
    assert {"events", "losses", "actions"} <= {file.stem for file in WITH_EXAMPLES}
