"""Memory that is too small is told in one sentence, before anything is compiled where it can be known."""

from __future__ import annotations

import types
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from edqn_jax.cli import commands, main
from edqn_jax.devices import memory
from edqn_jax.devices.memory import GIB, bytes_of, check_fits, host_bytes, memory_error, memory_of
from edqn_jax.errors import ConfigError
from edqn_jax.training import setup
from tests.support.configs import TINY_RUN


def card(limit: float, in_use: float = 0.0) -> Any:
    """Stands for a GPU with so many GiB."""
    said = {"bytes_limit": int(limit * GIB), "bytes_in_use": int(in_use * GIB)}
    return types.SimpleNamespace(platform="gpu", device_kind="NVIDIA H100", memory_stats=lambda: said)


def silent(platform: str) -> Any:
    """Stands for a device that does not say what it has."""
    return types.SimpleNamespace(platform=platform, device_kind=platform, memory_stats=lambda: None)


STATE = {
    "replay": jax.ShapeDtypeStruct((3, 2**28), jnp.float32),
    "keys": jax.eval_shape(lambda: jax.random.split(jax.random.key(0), 8)),
}
"""3 GiB and 64 bytes."""


def test_the_bytes_of_a_state_are_those_of_its_arrays() -> None:
    assert bytes_of(STATE) == 3 * GIB + 64
    assert bytes_of({"x": jnp.zeros((5, 3), jnp.int8)}) == 15


def test_a_state_that_is_larger_than_what_is_free_is_refused_with_both_numbers() -> None:
    check_fits(STATE, [card(4.0), card(4.0, in_use=0.5)])
    with pytest.raises(ConfigError, match=r"takes 3.00 GiB of memory, but the NVIDIA H100 has 2.00 GiB; a smaller --n"):
        check_fits(STATE, [card(4.0), card(2.0)])
    with pytest.raises(ConfigError, match=r"the NVIDIA H100 has 1.00 GiB free of 4.00 GiB; .*fewer --seeds"):
        check_fits(STATE, [card(4.0, in_use=3.0)])
    check_fits(STATE, [silent("gpu")])  # nobody knows


def test_a_machine_has_what_its_container_may_use(tmp_path: Path) -> None:
    given, none = tmp_path / "memory.max", tmp_path / "unlimited"
    given.write_text("1073741824\n")
    none.write_text("max\n")
    assert host_bytes([given, none, tmp_path / "missing"]) == GIB
    assert (host_bytes([none]) or 0) > GIB
    assert memory_of(silent("cpu")) == (host_bytes(), host_bytes())
    assert memory_of(silent("gpu")) is None


@pytest.mark.slow
def test_a_training_is_refused_before_it_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "memory_of", lambda device: (GIB // 2**18, GIB // 2**18))
    monkeypatch.setattr(setup.Trainer, "compile", lambda trainer: pytest.fail("it was compiled"))
    monkeypatch.setattr(setup.Trainer, "trace", lambda trainer: pytest.fail("it was traced"))
    with (
        pytest.raises(ConfigError, match="the train state takes .* GiB of memory, but this machine has 0.00 GiB"),
        setup.set_up_training(TINY_RUN),
    ):
        pass


@pytest.mark.parametrize(
    ("error", "asked"),
    [
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9964324126 bytes."), "9.28 GiB more"),
        (
            jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 9.28GiB."),
            "9.28 GiB more",
        ),
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: no room"), "is full: it has"),
        (MemoryError("Unable to allocate 9.28 GiB for an array with shape (3,)"), "9.28 GiB more"),
        (MemoryError(), "is full: it has"),
    ],
)
@pytest.mark.parametrize(
    ("words", "remedy"),
    [
        (["evaluate", "pretrained"], "fewer --missions need less"),
        (["train"], "a smaller --num-envs"),
        (["report", "runs/one"], "end what else uses it"),
    ],
)
def test_a_command_that_meets_full_memory_says_so(
    error: Exception,
    asked: str,
    words: list[str],
    remedy: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def full(*_: object) -> None:
        raise error

    monkeypatch.setattr(commands, "_dispatch", full)
    assert main(words) == 2
    said = capsys.readouterr().err
    assert said.startswith("edqn: the memory of this machine is full: ") and said.count("\n") == 1
    assert asked in said and remedy in said


def test_other_errors_stay_what_they_are() -> None:
    assert memory_error(jax.errors.JaxRuntimeError("INTERNAL: broken"), "train") is None
    assert memory_error(RuntimeError("needs 3 GiB"), "train") is None
