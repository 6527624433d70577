"""Whether a GPU has the memory that JAX takes when it starts; an `nvidia-smi` of the test's own answers."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import pytest

from edqn_jax.devices import gpu_memory
from edqn_jax.devices.gpu_memory import check_gpus_are_free, share_taken
from edqn_jax.errors import ConfigError

Answers = Callable[[str], dict[str, str]]


@pytest.fixture
def answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Answers:
    """Returns a function of what `nvidia-smi` says that returns the environment in which it says so."""
    monkeypatch.setattr(gpu_memory.importlib.util, "find_spec", lambda name: importlib.util)

    def answered(said: str) -> dict[str, str]:
        program = tmp_path / "nvidia-smi"
        program.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/asked\nprintf "{said}"\n')
        program.chmod(0o755)
        return {"PATH": f"{tmp_path}:/usr/bin:/bin"}

    return answered


def test_a_gpu_of_which_others_use_most_is_refused_with_the_share_that_is_left(answers: Answers) -> None:
    environ = answers("NVIDIA H100 80GB HBM3, 81559, 20390\\n")
    wanted = r"the NVIDIA H100 80GB HBM3 has 19.9 GiB of memory free, but JAX takes 75% of all, 59.7 GiB, .* at most "
    with pytest.raises(ConfigError, match=wanted + "XLA_CLIENT_MEM_FRACTION=0.25"):
        check_gpus_are_free(environ)
    with pytest.raises(ConfigError, match="at most XLA_PYTHON_CLIENT_MEM_FRACTION=0.25"):  # JAX refuses both
        check_gpus_are_free(environ | {"XLA_PYTHON_CLIENT_MEM_FRACTION": "0.9"})
    check_gpus_are_free(environ | {"XLA_PYTHON_CLIENT_MEM_FRACTION": "0.25"})
    check_gpus_are_free(environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"})
    check_gpus_are_free(environ | {"JAX_PLATFORMS": "cpu"})


def test_a_share_of_next_to_nothing_is_no_advice(answers: Answers) -> None:
    with pytest.raises(ConfigError, match="when it starts; end what else uses it$"):
        check_gpus_are_free(answers("A card, 81559, 300\\n"))


def test_every_gpu_that_the_process_may_use_counts(answers: Answers, tmp_path: Path) -> None:
    environ = answers("A card, with a comma, 1000, 900\\nAnother, 1000, 100\\n")
    with pytest.raises(ConfigError, match="the Another has 0.1 GiB"):
        check_gpus_are_free(environ | {"CUDA_VISIBLE_DEVICES": "0,1"})
    assert (tmp_path / "asked").read_text().startswith("-i 0,1 ")
    check_gpus_are_free(environ | {"CUDA_VISIBLE_DEVICES": ""})


@pytest.mark.parametrize("said", ["", "No devices were found\\n", "A card, [N/A], [N/A]\\n"])
def test_where_nobody_knows_nothing_is_refused(said: str, answers: Answers) -> None:
    check_gpus_are_free(answers(said))


def test_without_the_plugin_nobody_is_asked(answers: Answers, monkeypatch: pytest.MonkeyPatch) -> None:
    environ = answers("A card, 1000, 0\\n")
    monkeypatch.setattr(gpu_memory.importlib.util, "find_spec", lambda name: None)
    check_gpus_are_free(environ)


@pytest.mark.parametrize(
    ("environ", "share"),
    [
        ({}, 0.75),
        ({"XLA_PYTHON_CLIENT_MEM_FRACTION": "0.3"}, 0.3),
        ({"XLA_CLIENT_MEM_FRACTION": "0.2", "XLA_PYTHON_CLIENT_MEM_FRACTION": "0.3"}, 0.2),
        ({"XLA_CLIENT_MEM_FRACTION": "much"}, 0.75),
        ({"XLA_PYTHON_CLIENT_PREALLOCATE": "False"}, None),
        ({"XLA_PYTHON_CLIENT_ALLOCATOR": "platform"}, None),
    ],
)
def test_the_share_is_what_the_variables_say(environ: dict[str, str], share: float | None) -> None:
    assert share_taken(environ) == share
