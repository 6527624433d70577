"""The list of mutants fits the code; `python tests/mutants/run.py` applies it."""

from __future__ import annotations

import re
from collections import Counter

import pytest

from tests.mutants.run import ROOT, Mutant, failure, load_mutants, mutated

MUTANTS = load_mutants()


@pytest.mark.parametrize("mutant", MUTANTS, ids=[mutant.name for mutant in MUTANTS])
def test_a_mutant_changes_one_place_and_names_tests_that_there_are(mutant: Mutant) -> None:
    text = mutated(mutant, ROOT)
    if mutant.file.endswith(".py"):
        compile(text, mutant.file, "exec")
    assert mutant.replace != mutant.find
    for test in mutant.tests:
        file, function = test.split("::")
        assert re.search(rf"^def {function}\(", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), test


def test_each_package_has_at_least_two_mutants() -> None:
    count = Counter(mutant.package for mutant in MUTANTS)
    for package in ("config", "sim", "planners", "learn", "runs", "evaluation", "training"):
        assert count[package] >= 2, package


def test_only_a_test_that_fails_kills_a_mutant() -> None:
    assert (
        failure(1, "F\nFAILED tests/test_a.py::test_b - assert 1 == 2\n") == "tests/test_a.py::test_b - assert 1 == 2"
    )
    assert failure(1, "E\nERROR tests/test_a.py::test_b - NameError\n") is None
    assert failure(2, "ERROR tests/test_a.py - SyntaxError\n") is None
    assert failure(0, "1 passed\n") is None
