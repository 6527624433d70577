"""The Python blocks of every page run from top to bottom, as a reader would run them.

Training is cut short, and flights are few: what is tested is that the code runs, not how well it flies. Pages on
other people's libraries and on deployment have tests of their own, as has the README (tests/whole/test_examples.py).
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

import edqn_jax
from edqn_jax.config import Config
from tests.support.pages import PAGES, blocks_of, empty_module, name_of
from tests.support.registries import keep_as_they_are

ELSEWHERE = ("README.md", *(f"docs/{page}.md" for page in ("runner", "functional", "gymnasium", "sweeps")))

PYTHON = [page for page in PAGES if name_of(page) not in ELSEWHERE and blocks_of(page, "python")]

CONVENTIONAL = "from conventional_stack"
"""Begins the block that trains the conventional stack, whose parts tests/bench runs; here it is only compiled."""


def small(config: Config) -> Config:
    """Returns a configuration that is trained within seconds."""
    train = dataclasses.replace(
        config.train, num_envs=16, total_steps=1024, chunk_steps=32, validation_missions=4, validation_every=0
    )
    agent = dataclasses.replace(config.agent, batch_size=16, replay_size=1024, learning_starts=256)
    encoder = dataclasses.replace(config.encoder, batch_size=16, replay_size=512, retrain_at=())
    world = dataclasses.replace(config.world, pool_size=16, missions=32)
    return dataclasses.replace(config, train=train, agent=agent, encoder=encoder, world=world)


@pytest.mark.parametrize("page", PYTHON, ids=name_of)
def test_the_examples_of_a_page_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train, evaluate = edqn_jax.train, edqn_jax.evaluate

    def trained(config: Config, **options: Any) -> edqn_jax.TrainingResult:
        return train(small(config), **options)

    def evaluated(policy: edqn_jax.Policy, *where: Any, missions: int = 1, **options: Any) -> edqn_jax.Evaluation:
        return evaluate(policy, *where, missions=min(missions, 4), **options)

    monkeypatch.setattr(edqn_jax, "train", trained)
    monkeypatch.setattr(edqn_jax, "evaluate", evaluated)
    monkeypatch.chdir(tmp_path)
    keep_as_they_are(monkeypatch)
    for world in blocks_of(page, "xml"):
        Path("mine.xml").write_text(world, encoding="utf-8")
    names = empty_module(f"page_{page.stem}", monkeypatch)
    for number, code in enumerate(blocks_of(page, "python")):
        program = compile(code, f"{name_of(page)}, block {number}", "exec")
        if not code.startswith(CONVENTIONAL):
            exec(program, names)


def test_pages_with_examples_are_found() -> None:
    assert {"docs/quickstart.md", "docs/api.md", "docs/howto/own_agent.md"} <= {name_of(page) for page in PYTHON}
