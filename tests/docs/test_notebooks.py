"""The notebooks have a picture and no outputs, ids that stay, and use the public API alone. CI runs them."""

from __future__ import annotations

import ast
import base64
import io
import re
from importlib import import_module
from pathlib import Path

import nbformat
import pytest
from PIL import Image

import edqn_jax

FOLDER = Path(__file__).parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_notebook_is_stored_without_outputs(file: Path) -> None:
    notebook = nbformat.read(file, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in code)
    assert [cell.id for cell in notebook.cells] == [f"cell-{number:02d}" for number in range(len(notebook.cells))]


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_notebook_uses_the_public_api_alone(file: Path) -> None:
    cells = nbformat.read(file, as_version=4).cells
    tree = ast.parse("\n".join(cell.source for cell in cells if cell.cell_type == "code"))
    imported = {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    imported |= {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert {name for name in imported if name.startswith("edqn_jax")} == {"edqn_jax"}
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "edqn_jax"
    }
    assert used and used <= set(edqn_jax.__all__)


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_notebook_begins_with_a_picture(file: Path) -> None:
    first = nbformat.read(file, as_version=4).cells[0].source
    (picture,) = re.findall(r"!\[.{20,}\]\((\S+\.png)\)", first)
    with Image.open(FOLDER / picture) as shown:
        assert shown.width >= 400


def test_the_picture_of_a_notebook_is_one_of_its_outputs_and_small(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(FOLDER.parent / "scripts"))
    write_picture = import_module("notebook_pictures").write_picture
    cell = nbformat.v4.new_code_cell("draw()")
    for colour in ("red", "blue"):
        file = io.BytesIO()
        Image.new("RGB", (1640, 400), colour).save(file, "PNG")
        data = {"image/png": base64.b64encode(file.getvalue()).decode()}
        cell.outputs.append(nbformat.v4.new_output("display_data", data=data))
    notebook = nbformat.v4.new_notebook(cells=[cell])
    nbformat.write(notebook, tmp_path / "4_name.ipynb")
    with Image.open(write_picture(tmp_path / "4_name.ipynb", tmp_path)) as written:
        assert (written.size, written.convert("RGB").getpixel((5, 5))) == ((820, 200), (0, 0, 255))
    nbformat.write(nbformat.v4.new_notebook(), tmp_path / "5_name.ipynb")
    assert write_picture(tmp_path / "5_name.ipynb", tmp_path) is None


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_notebooks_links_lead_to_files(file: Path) -> None:
    text = "\n".join(cell.source for cell in nbformat.read(file, as_version=4).cells if cell.cell_type == "markdown")
    links = [link for link in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in link]
    assert not [link for link in links if not (FOLDER / link).exists()]


def test_the_notebooks_are_numbered_from_one() -> None:
    assert [int(file.stem.split("_")[0]) for file in NOTEBOOKS] == list(range(1, 8))
