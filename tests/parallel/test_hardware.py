"""Hardware is told from device files, plugins and the environment alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from edqn_jax.parallel import hardware as module
from edqn_jax.parallel.hardware import hardware


@pytest.fixture
def with_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "nvidia0").touch()
    monkeypatch.setattr(module, "_has_plugin", lambda: True)
    return tmp_path


@pytest.mark.parametrize("card", ["nvidia0", "nvidia3", "kfd", "dxg"])
def test_a_card_with_its_plugin_is_a_gpu(card: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / card).touch()
    monkeypatch.setattr(module, "_has_plugin", lambda: True)
    assert hardware({}, tmp_path) == "gpu"
    monkeypatch.setattr(module, "_has_plugin", lambda: False)
    assert hardware({}, tmp_path) == "cpu"


def test_a_plugin_without_a_card_is_no_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "nvidiactl").touch()
    monkeypatch.setattr(module, "_has_plugin", lambda: True)
    assert hardware({}, tmp_path) == "cpu"


@pytest.mark.parametrize(
    ("environ", "found"),
    [
        ({"JAX_PLATFORMS": "cpu"}, "cpu"),
        ({"JAX_PLATFORMS": "cuda,cpu"}, "gpu"),
        ({"JAX_PLATFORMS": ""}, "gpu"),
        ({"CUDA_VISIBLE_DEVICES": ""}, "cpu"),
        ({"CUDA_VISIBLE_DEVICES": "-1"}, "cpu"),
        ({"CUDA_VISIBLE_DEVICES": "1"}, "gpu"),
    ],
)
def test_the_environment_can_hide_it(environ: dict[str, str], found: str, with_card: Path) -> None:
    assert hardware(environ, with_card) == found


def test_a_plugin_is_a_module_of_that_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not module._has_plugin()  # the project does not depend on one
    (tmp_path / "jax_cuda13_plugin").mkdir()
    (tmp_path / "jax_cuda13_plugin" / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    assert module._has_plugin()
