"""Modules import from below; `docs/architecture.md` says what each place contains."""

from __future__ import annotations

import ast
import functools
from collections import Counter
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

ORDER = (
    *(
        "version",
        "errors",
        "keys",
        "files",
        "checks",
        "extras",
        "user_code",
        "watchers",
        "registries",
        "xla_flags",
        "xla",
        "sine",
        "config",
        "devices",
        "native",
        "kept_programs",
    ),
    *("sim.actions", "sim.scene", "sim.worlds", "sim.physics", "sim.camera", "sim.sensors", "sim.task", "sim"),
    *("planning", "learn.perception", "learn", "policies", "evaluation", "training"),
    *("runs.checkpoints", "runs", "runs.verification", "report", "interop", "fly", "cli.process", "cli"),
)
"""Places of the package: a module imports from its own place and from those before it."""


def modules_below(folder: Path) -> dict[str, Path]:
    """Returns the file of each module below a folder of the checkout, by the module's full name."""
    parts = {file: file.relative_to(folder.parent).with_suffix("").parts for file in folder.rglob("*.py")}
    return {".".join(part for part in names if part != "__init__"): file for file, names in parts.items()}


def imported_by(source: str, known: dict[str, Path]) -> set[str]:
    """Returns which of the known modules a source imports: anywhere, also in functions and for types alone."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            full = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in known else str(node.module) for name in full}
    return found & known.keys()


def place_of(module: str) -> str:
    """Returns the place of a module: the longest of `ORDER` that it lies in."""
    inside = [place for place in ORDER if f"{module}.".startswith(f"edqn_jax.{place}.")]
    assert inside, f"{module} has no place in ORDER"
    return max(inside, key=len)


PACKAGE = modules_below(ROOT / "edqn_jax")
FACES = {"edqn_jax", "edqn_jax.__main__"}
"""They stand above all places."""


@functools.cache
def arrows() -> dict[str, set[str]]:
    """Returns what each module imports."""
    return {name: imported_by(file.read_text(encoding="utf-8"), PACKAGE) for name, file in PACKAGE.items()}


@pytest.mark.parametrize("name", sorted(PACKAGE.keys() - FACES))
def test_a_module_imports_from_its_own_place_and_from_those_below(name: str) -> None:
    above = ORDER[ORDER.index(place_of(name)) + 1 :]
    assert [to for to in sorted(arrows()[name]) if to in FACES or place_of(to) in above] == []


def test_no_modules_import_each_other_in_a_circle() -> None:
    try:
        TopologicalSorter(arrows()).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_imports_in_functions_and_for_types_count() -> None:
    source = "if TYPE_CHECKING:\n    from edqn_jax.cli import train\ndef f():\n    import edqn_jax.keys\n"
    assert imported_by(source, PACKAGE) == {"edqn_jax.cli.train", "edqn_jax.keys"}


def test_the_package_imports_no_benchmark() -> None:
    names = modules_below(ROOT / "benchmarks") | {path.stem: path for path in (ROOT / "benchmarks").iterdir()}
    arrows = {name: imported_by(file.read_text(encoding="utf-8"), names) for name, file in PACKAGE.items()}
    assert {name: found for name, found in arrows.items() if found} == {}


def test_no_folder_of_the_package_holds_more_than_15_modules() -> None:
    held = Counter(file.parent.relative_to(ROOT) for file in PACKAGE.values())
    assert {str(folder): count for folder, count in held.items() if count > 15} == {}


def test_training_stores_and_draws_nothing() -> None:
    sources = [file.read_text(encoding="utf-8") for file in (ROOT / "edqn_jax" / "training").glob("*.py")]
    assert not any(word in source for source in sources for word in ("matplotlib", "write_atomically", "edqn_jax.runs"))
