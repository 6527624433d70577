"""The README's Python example runs as it is printed, its XML is a world, and its links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import jax
import pytest

from edqn_jax.config import Config
from edqn_jax.sim.mjcf import check_scene, load_world
from edqn_jax.sim.outcomes import Outcome

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    """The only code block of a language."""
    found = re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)
    assert len(found) == 1
    return found[0]


@pytest.mark.slow
def test_the_python_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {}
    exec(compile(block("python"), "README.md", "exec"), names)
    step = names["step"]
    assert int(step.outcome) == Outcome.RUNNING
    # Straight ahead from (1, 1, 3): both horizontal coordinates grow and the height is held.
    x, y, z = jax.device_get(step.flight.position[-1])
    assert x > 2.5 and y > 2.5 and abs(z - 3.0) < 0.1
    assert int(step.observation.sensed.count.sum()) > 0
    assert "(" in capsys.readouterr().out


def test_the_python_example_has_at_most_ten_lines_besides_imports() -> None:
    lines = [line for line in block("python").splitlines() if line.strip()]
    assert len([line for line in lines if "import " not in line]) <= 10


def test_the_drawn_world_can_be_flown(tmp_path: Path) -> None:
    file = tmp_path / "mine.xml"
    file.write_text(block("xml"), encoding="utf-8")
    loaded = load_world(file)
    check_scene(loaded.scene, Config().drone.body_radius_m, names=loaded.names, title="'mine.xml'")


def test_the_two_commands_are_the_promised_ones() -> None:
    assert "\npython3 -m venv .venv && .venv/bin/pip install -e . && .venv/bin/python train.py\n" in README
    assert "\n.venv/bin/pip install -e '.[test]' && .venv/bin/pytest\n" in README


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))], ids=lambda p: p.stem)
def test_relative_links_lead_to_files(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing
