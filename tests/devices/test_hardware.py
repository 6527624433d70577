"""Hardware is told from device files, plugins and the environment alone."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from edqn_jax.devices import hardware as module
from edqn_jax.devices.hardware import describe_processor, detect_hardware


def installed(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Makes these the only modules that can be imported, as far as `detect_hardware` looks."""
    modules = [SimpleNamespace(name=name) for name in names]
    monkeypatch.setattr(module.pkgutil, "iter_modules", lambda: modules)


@pytest.fixture
def with_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "nvidia0").touch()
    installed(monkeypatch, "jax", "jax_cuda13_plugin")
    return tmp_path


@pytest.mark.parametrize(
    ("card", "plugin", "found"),
    [
        ("nvidia0", "jax_cuda12_plugin", "gpu"),
        ("nvidia3", "jax_cuda13_plugin", "gpu"),
        ("dxg", "jax_cuda13_plugin", "gpu"),
        ("kfd", "jax_rocm7_plugin", "gpu"),
        ("kfd", "jax_cuda13_plugin", "cpu"),
        ("nvidia0", "jax_rocm7_plugin", "cpu"),
        ("nvidia0", "jax", "cpu"),
        ("nvidiactl", "jax_cuda13_plugin", "cpu"),
    ],
)
def test_a_card_with_its_plugin_is_a_gpu(
    card: str, plugin: str, found: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / card).touch()
    installed(monkeypatch, plugin)
    assert detect_hardware({}, tmp_path) == found


@pytest.mark.parametrize(
    ("environ", "found"),
    [
        ({"JAX_PLATFORMS": "cpu"}, "cpu"),
        ({"JAX_PLATFORMS": "cuda,cpu"}, "gpu"),
        ({"JAX_PLATFORMS": "cpu,cuda"}, "cpu"),
        ({"JAX_PLATFORMS": ""}, "gpu"),
        ({"CUDA_VISIBLE_DEVICES": ""}, "cpu"),
        ({"CUDA_VISIBLE_DEVICES": "-1"}, "cpu"),
        ({"CUDA_VISIBLE_DEVICES": "1"}, "gpu"),
    ],
)
def test_the_environment_can_hide_it(environ: dict[str, str], found: str, with_card: Path) -> None:
    assert detect_hardware(environ, with_card) == found


def test_a_processor_is_told_from_one_of_the_same_name(tmp_path: Path) -> None:
    file = tmp_path / "cpuinfo"
    file.write_text(
        "processor\t: 0\ncpu family\t: 25\nmodel\t\t: 17\nmodel name\t: AMD EPYC\nstepping\t: 1\n\nmodel\t: 9\n"
    )
    cores = f"{module.count_cores()} cores"
    assert describe_processor(file) == f"AMD EPYC (family 25, model 17, stepping 1), {cores}"
    file.write_text("processor : 0\nCPU part : 0xd40\n")  # Arm has other numbers
    assert describe_processor(file) == describe_processor(tmp_path / "none") == f"{module.platform.machine()}, {cores}"
