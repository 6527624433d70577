"""The README is short, its XML is a world, and its links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from edqn_jax.config import Config
from edqn_jax.sim.scene.mjcf import check_scene, load_world
from tests.support.pages import ROOT, blocks_of

README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_python_examples_have_at_most_seven_lines() -> None:
    assert [len(block.splitlines()) <= 7 for block in blocks_of(ROOT / "README.md", "python")] == [True, True]


def test_the_readme_is_read_in_one_minute() -> None:
    assert len(README.splitlines()) <= 120 and len(README.split()) <= 700


def test_each_of_five_results_leads_to_the_page_that_has_it_and_a_blind_agent_stands_beside_success() -> None:
    rows = [line.strip("| ").split(" | ") for line in README.splitlines() if line.startswith("| [")]
    assert len(rows) == 5 and all("](docs/" in row[0] or "README.md#" in row[0] for row in rows)
    assert all("%" in row[2] for row in rows if "%" in row[1])


def test_the_drawn_world_can_be_flown(tmp_path: Path) -> None:
    file = tmp_path / "mine.xml"
    file.write_text(blocks_of(ROOT / "README.md", "xml")[0], encoding="utf-8")
    loaded = load_world(file)
    check_scene(loaded.scene, Config().drone.body_radius_m, names=loaded.names, title="'mine.xml'")


def test_the_two_commands_are_the_promised_ones() -> None:
    assert "\npython3 -m venv .venv && .venv/bin/pip install -e . && .venv/bin/python train.py\n" in README
    assert "\n.venv/bin/pip install -e '.[test]' && .venv/bin/pytest\n" in README


CARDS = sorted((ROOT / "edqn_jax/policies").glob("*/README.md"))


@pytest.mark.parametrize(
    "page",
    [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *CARDS],
    ids=lambda p: f"{p.parent.name}-{p.stem}",
)
def test_relative_links_lead_to_files(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing
