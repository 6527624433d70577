"""The notebook runs from top to bottom, and after it the README's examples as they are printed."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from tests.docs.test_readme import blocks

NOTEBOOK = Path(__file__).parents[2] / "notebooks" / "flight_and_events.ipynb"


FLOWN = """
x, y, z = map(float, step.flight.position[-1])
# Ahead from (1, 1, 3), where the goal lies: both horizontal coordinates grow; the second move climbs too.
assert int(step.outcome) == edqn_jax.Outcome.RUNNING and x > 1.5 and y > 1.5 and 3.1 < z < 4.5
assert len(environment.events(step.observation)) > 0
"""
"""What the README's first example must have come to."""

MINIATURE = "edqn_jax.make_config = lambda world: {'paper': config}[world]"
"""The README's second example is given the notebook's configuration, and so its compiled programs."""


@pytest.mark.slow
def test_the_notebook_and_the_readmes_examples_run() -> None:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    first, second = blocks("python")
    examples = [nbformat.v4.new_code_cell(code) for code in (first, FLOWN, MINIATURE, second)]
    notebook.cells += examples
    # From the checkout's root, where the package is found whether it is installed or not.
    where = {"metadata": {"path": str(NOTEBOOK.parents[1])}}
    client = NotebookClient(notebook, timeout=300, kernel_name="python3", resources=where)
    client.execute()
    pictures = [
        output for cell in notebook.cells for output in cell.get("outputs", []) if "image/png" in output.get("data", {})
    ]
    assert len(pictures) == 2
    flown, measured = ("".join(output["text"] for output in examples[cell].outputs) for cell in (0, 3))
    assert "(" in flown and "'missions': 100" in measured


def test_the_notebook_is_stored_without_outputs() -> None:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    assert all(not cell.get("outputs") for cell in notebook.cells)
