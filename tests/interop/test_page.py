"""The examples of the page on Gymnasium run as they stand."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "gymnasium.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize("example", EXAMPLES, ids=range(len(EXAMPLES)))
@pytest.mark.filterwarnings("ignore::UserWarning:stable_baselines3")
def test_it_runs(example: str, capsys: pytest.CaptureFixture[str]) -> None:
    exec(example, {})
    assert "Error" not in capsys.readouterr().err


def test_there_are_examples() -> None:
    assert len(EXAMPLES) == 4
