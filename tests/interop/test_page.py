"""The examples of the pages on other people's libraries run as they stand."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

import edqn_jax
from edqn_jax.config import Config
from tests.support.interop.tiny import tiny_trial

DOCS = Path(__file__).parents[2] / "docs"


def examples(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


EXAMPLES = {
    f"{page}-{number}": example
    for page in ("disturbances.md", "functional.md", "gymnasium.md")
    for number, example in enumerate(examples(page))
}


@pytest.mark.parametrize("example", EXAMPLES.values(), ids=EXAMPLES)
@pytest.mark.filterwarnings("ignore::UserWarning:stable_baselines3")
def test_it_runs(example: str, capsys: pytest.CaptureFixture[str]) -> None:
    exec(example, {})
    assert "Error" not in capsys.readouterr().err


def test_there_are_examples() -> None:
    assert len(EXAMPLES) == 8


@pytest.mark.filterwarnings("ignore::Warning:optuna.*", "ignore::Warning:sqlalchemy.*")
def test_the_search_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    (example,) = [text for text in examples("sweeps.md") if "import optuna" in text]
    asked: list[Config] = []
    make_config = edqn_jax.make_config

    def small(*words: str, **groups: dict) -> Config:
        asked.append(make_config(*words, **groups))
        return tiny_trial(asked[-1])

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(edqn_jax, "make_config", small)
    exec(example, {})
    assert len(asked) == 2 and {config.train.total_steps for config in asked} == {500_000}
    assert "learning_rate" in capsys.readouterr().out and (tmp_path / "sweep.db").is_file()


def test_the_example_for_ray_is_python_on_the_public_api() -> None:
    (example,) = [text for text in examples("sweeps.md") if "from ray import tune" in text]
    compile(example, "sweeps.md", "exec")
    names = set(re.findall(r"edqn_jax\.(\w+)", example))
    assert names == {"train", "make_config"} <= set(edqn_jax.__all__)
    groups = edqn_jax.make_config(
        "medium", agent={"learning_rate": 1e-3, "n_step": 7}, train={"validation_every": 125_000}
    )
    assert dataclasses.is_dataclass(groups)
