"""The examples of the pages on the runner and on files of events run."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from edqn_jax.interop.deployment.onnx_export import export_policy
from edqn_jax.runs.policies import load_policy

DOCS = Path(__file__).parents[2] / "docs"

pytestmark = pytest.mark.filterwarnings("ignore")  # jax2onnx and what it imports


def examples(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


def test_the_runner_of_the_page_decides(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    export_policy(load_policy("pretrained"), tmp_path / "policy.onnx", checks=20)
    exec(examples("runner.md")[0], {})
    assert re.match(r"\d+ \[", capsys.readouterr().out)


def test_the_events_of_the_page_are_written_and_read(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for example in examples("event_files.md"):
        exec(example, {})
    assert "(346, 260)" in capsys.readouterr().out
    shutil.rmtree(tmp_path)
