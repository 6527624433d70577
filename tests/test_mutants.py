"""The list of mutants fits the code; `python tests/mutants/run.py` applies it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.mutants.mutant import Mutant, MutantError, find_test, load_mutants, put_into
from tests.mutants.run import ROOT, failure

MUTANTS = load_mutants()


@pytest.mark.parametrize("mutant", MUTANTS, ids=[mutant.name for mutant in MUTANTS])
def test_a_mutant_changes_one_place_and_names_tests_that_there_are(mutant: Mutant) -> None:
    bug = put_into(mutant, ROOT)
    if bug.file.endswith(".py"):
        compile(bug.text, bug.file, "exec")
    assert bug.text != (ROOT / bug.file).read_text(encoding="utf-8")
    for test in mutant.tests:
        find_test(test, ROOT)


def test_each_package_has_at_least_two_mutants() -> None:
    count = Counter(put_into(mutant, ROOT).file.split("/")[1] for mutant in MUTANTS)
    for package in ("config", "sim", "planning", "learn", "runs", "evaluation", "training"):
        assert count[package] >= 2, package


def test_a_mutant_is_found_wherever_its_function_is_and_however_it_is_written(tmp_path: Path) -> None:
    moved = tmp_path / "edqn_jax" / "elsewhere.py"
    moved.parent.mkdir()
    moved.write_text(
        "class A:\n    def f(self, x):\n        return max(\n            x,\n            'y',\n        )\n"
    )
    mutant = Mutant("shortest", "", "A.f", 'max(x, "y")', "min(x, 'y')", ())
    bug = put_into(mutant, tmp_path)
    assert bug.file == "edqn_jax/elsewhere.py"
    assert bug.text == "class A:\n    def f(self, x):\n        return (min(x, 'y'))\n"


def test_a_mutant_that_fits_twice_is_refused(tmp_path: Path) -> None:
    (tmp_path / "edqn_jax").mkdir()
    (tmp_path / "edqn_jax" / "a.py").write_text("def f(x):\n    return g(x) + g(x)\n")
    with pytest.raises(MutantError, match="is 2 times in 'f'; it must be once"):
        put_into(Mutant("twice", "", "f", "g(x)", "x", ()), tmp_path)


def test_only_a_test_that_fails_kills_a_mutant() -> None:
    assert (
        failure(1, "F\nFAILED tests/test_a.py::test_b - assert 1 == 2\n") == "tests/test_a.py::test_b - assert 1 == 2"
    )
    assert failure(1, "E\nERROR tests/test_a.py::test_b - NameError\n") is None
    assert failure(2, "ERROR tests/test_a.py - SyntaxError\n") is None
    assert failure(0, "1 passed\n") is None
