"""How many devices a run uses."""

from __future__ import annotations

import os
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import pytest

from edqn_jax.devices import devices
from edqn_jax.devices.devices import choose_devices, describe_idle_cores, most_that_divide, use_cpu_devices
from edqn_jax.devices.hardware import count_cores
from edqn_jax.errors import ConfigError


@pytest.mark.parametrize(("shards", "available", "used"), [(8, 2, 2), (8, 3, 2), (8, 7, 4), (8, 64, 8), (6, 4, 3)])
def test_as_many_devices_as_divide_the_shards(shards, available, used):
    assert most_that_divide(shards, available) == used


@pytest.mark.parametrize(
    ("cores", "says"),
    [
        (8, ""),
        (12, ""),  # neither 12 nor 9 to 11 divide what is batched
        (16, "8 of 16 cores; with --train.shards 16 it uses 16"),
        (24, "8 of 24 cores; with --train.shards 16 it uses 16"),
        (2, ""),
    ],
)
def test_idle_cores_are_told_where_more_shards_would_use_them(cores: int, says: str) -> None:
    said = describe_idle_cores(8, (256, 256, 512), cores)
    assert says in said and bool(said) is bool(says)


def test_no_request_takes_what_divides_and_a_request_takes_just_that():
    assert choose_devices(0, 8) == jax.devices()[:2]
    assert choose_devices(1, 8) == jax.devices()[:1]
    assert choose_devices(0, 7) == jax.devices()[:1]


def test_more_devices_than_there_are_is_named():
    with pytest.raises(ConfigError, match="train.devices must be at most 2, the number of CPU devices found, not 4"):
        choose_devices(4, 8)


def test_a_number_that_does_not_divide_the_shards_is_named():
    with pytest.raises(ConfigError, match="must be a divisor of train.shards"):
        choose_devices(2, 7)


@pytest.fixture
def three_of_each_of_two(monkeypatch: pytest.MonkeyPatch) -> list[types.SimpleNamespace]:
    """Two processes with three devices each, told in a mixed order."""
    found = [types.SimpleNamespace(process_index=i % 2, id=i, platform="gpu") for i in range(6)]
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(jax, "devices", lambda: found)
    monkeypatch.setattr(jax, "local_devices", lambda process: [d for d in found if d.process_index == process])
    return found


@pytest.mark.parametrize(
    ("requested", "shards", "chosen"),
    [(0, 8, [0, 2, 1, 3]), (0, 6, [0, 2, 4, 1, 3, 5]), (0, 10, [0, 1]), (2, 8, [0, 1])],
)
def test_every_process_brings_as_many_devices(three_of_each_of_two, requested, shards, chosen):
    assert choose_devices(requested, shards) == [three_of_each_of_two[i] for i in chosen]


@pytest.mark.parametrize(
    ("requested", "shards", "says"),
    [
        (0, 7, "train.shards must be a multiple of the 2 processes, not 7"),
        (1, 8, "train.devices must be a multiple of the 2 processes, not 1"),
        (8, 8, "train.devices must be at most 6, the number of GPU devices found, not 8"),
    ],
)
def test_what_processes_cannot_share_is_named(three_of_each_of_two, requested, shards, says):
    with pytest.raises(ConfigError, match=says):
        choose_devices(requested, shards)


def test_devices_cannot_be_made_once_jax_runs():
    jax.devices()
    with pytest.raises(RuntimeError):
        use_cpu_devices(2 + count_cores())


@pytest.mark.parametrize(
    ("version", "partitioner"),
    [((0, 10, 2), {}), ((0, 11, 0), {"jax_use_shardy_partitioner": False}), ((0, 12, 0), {})],
)
def test_only_jax_0_11_is_told_to_use_the_old_partitioner(version, partitioner, monkeypatch):
    told: dict[str, Any] = {}
    config = types.SimpleNamespace(update=told.__setitem__)
    monkeypatch.setattr(devices, "jax", types.SimpleNamespace(config=config, __version_info__=version))
    use_cpu_devices(3)
    assert told == {"jax_num_cpu_devices": 3, **partitioner}


@pytest.mark.parametrize(
    ("given", "then"),
    [
        ("", devices.DETERMINISTIC_ROUNDING_FLAG),
        ("--xla_cpu_max_isa=AVX", f"--xla_cpu_max_isa=AVX {devices.DETERMINISTIC_ROUNDING_FLAG}"),
        ("--xla_backend_extra_options=a", "--xla_backend_extra_options=a"),
    ],
)
def test_loops_are_left_as_they_are_unless_somebody_gave_options_of_their_own(given, then, monkeypatch):
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    monkeypatch.setenv("XLA_FLAGS", given)
    use_cpu_devices(2)
    assert os.environ["XLA_FLAGS"] == then


@pytest.fixture
def asked_anew() -> Iterator[None]:
    """Clears the cached set of options that XLA knows."""
    devices.compiler_options.cache_clear()
    yield
    devices.compiler_options.cache_clear()


def test_xla_knows_our_options_and_accelerators_have_none(asked_anew, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    known = {"xla_cpu_experimental_ynn_fusion_type", "xla_backend_optimization_level"}
    assert set(devices.compiler_options("cpu")) == known
    assert devices.compiler_options("tpu") == {}


def test_a_level_of_optimisation_that_somebody_chose_is_kept(asked_anew, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=0")
    assert "xla_backend_optimization_level" not in devices.compiler_options("cpu")


def test_an_option_that_xla_does_not_know_is_left_out(asked_anew, monkeypatch):
    jit = jax.jit
    misspelt = {"xla_cpu_of_another_century": "1"}
    monkeypatch.setattr(jax, "jit", lambda f, compiler_options: jit(f, compiler_options=compiler_options and misspelt))
    assert devices.compiler_options("cpu") == {}


def test_flags_of_xla_in_a_file_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "flags"
    file.write_text("--xla_cpu_enable_fast_math=false\n", encoding="utf-8")
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    monkeypatch.setenv("XLA_FLAGS", str(file))
    use_cpu_devices(1)
    assert os.environ["XLA_FLAGS"] == f"--xla_cpu_enable_fast_math=false {devices.DETERMINISTIC_ROUNDING_FLAG}"


def test_what_tests_compile_is_quick_to_compile_though_the_package_adds_a_flag_of_its_own() -> None:
    environ = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    code = "import os, tests.conftest; print(os.environ['XLA_FLAGS'])"
    said = subprocess.run([sys.executable, "-c", code], env=environ, text=True, capture_output=True, check=True)
    assert "xla_backend_optimization_level=0" in said.stdout and "ynn_fusion_type=" in said.stdout
