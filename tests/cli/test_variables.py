"""Variables of the environment that would change or end a command, and what is said of those that cannot be obeyed."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable

import jax
import pytest

from edqn_jax.cli.process import variables
from edqn_jax.cli.process.variables import check_devices, prepare_process, start_jax
from edqn_jax.errors import ConfigError


@pytest.mark.parametrize(
    ("given", "kept"),
    [("0", "60"), ("10", "60"), ("-3", "60"), ("many", "60"), ("", "60"), ("60", "60"), ("120", "120")],
)
def test_tables_have_room_for_their_numbers(given: str, kept: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", given)
    prepare_process()
    assert os.environ["COLUMNS"] == kept


def test_the_backend_of_a_notebook_is_not_a_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "module://of.a.notebook")
    prepare_process()
    assert os.environ["MPLBACKEND"] == "agg"
    monkeypatch.delenv("MPLBACKEND")
    prepare_process()
    assert "MPLBACKEND" not in os.environ


@pytest.mark.parametrize(("options", "raised"), [(["error"], False), (["error::UserWarning"], False), ([], True)])
def test_warnings_of_packages_end_no_command(options: list[str], raised: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "warnoptions", options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        prepare_process()
        if raised:  # the filters are those of a program around, such as these tests
            with pytest.raises(UserWarning):
                warnings.warn("from a package", UserWarning, stacklevel=1)
        else:
            with warnings.catch_warnings(record=True):
                warnings.warn("from a package", UserWarning, stacklevel=1)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--xla_no_such_flag", "XLA refuses XLA_FLAGS='--xla_no_such_flag': Unknown flag in XLA_FLAGS: --xla_no_such"),
        ("--xla_cpu_enable_fast_math=maybe", "Couldn't interpret value maybe for flag xla_cpu_enable_fast_math"),
        ("no_such_file", 'Could not open file "no_such_file"'),
    ],
)
def test_flags_that_would_end_the_process_are_refused(flags: str, said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        variables._check_xla_flags({**os.environ, "XLA_FLAGS": flags})
    assert said in str(refused.value) and "\n" not in str(refused.value)


def test_flags_that_xla_knows_are_not_refused() -> None:
    variables._check_xla_flags({**os.environ, "XLA_FLAGS": "--xla_cpu_enable_fast_math=false"})
    variables._check_xla_flags({**os.environ, "XLA_FLAGS": " "})


def refuses(error: Exception) -> Callable[[], object]:
    """Stands for JAX's search for devices."""

    def devices() -> object:
        raise error

    return devices


@pytest.mark.parametrize("error", [AssertionError(), RuntimeError("Unable to initialize backend 'quantum'")])
def test_a_platform_that_is_not_there_is_named(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "devices", refuses(error))
    monkeypatch.setenv("JAX_PLATFORMS", "quantum")
    with pytest.raises(ConfigError, match="JAX_PLATFORMS is 'quantum', but JAX finds no such devices here; unset it"):
        check_devices()
    monkeypatch.delenv("JAX_PLATFORMS")
    with pytest.raises(type(error)):  # nobody asked for it
        check_devices()


def test_capitals_and_spaces_make_no_other_platform(monkeypatch: pytest.MonkeyPatch) -> None:
    before = jax.config.values["jax_platforms"]
    monkeypatch.setenv("JAX_PLATFORMS", " CPU, cuda,")
    try:
        start_jax()
        assert jax.config.values["jax_platforms"] == "cpu,cuda"
    finally:
        jax.config.update("jax_platforms", before)


def test_settings_that_are_not_used_are_told_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    jax.config.update("jax_debug_nans", True)
    jax.config.update("jax_numpy_rank_promotion", "raise")
    start_jax()
    said = "JAX_NUMPY_RANK_PROMOTION=raise, JAX_DEBUG_NANS=True are set, but commands use the settings of JAX that were"
    assert capsys.readouterr().err == f"edqn: {said} tested\n"
    start_jax()
    assert capsys.readouterr().err == ""


def test_devices_that_jax_cannot_use_are_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    said = "Unable to initialize backend 'cuda': INTERNAL: no supported devices found for platform CUDA (you may need"
    monkeypatch.setattr(jax, "devices", refuses(RuntimeError(said)))
    for name in ("JAX_PLATFORMS", "JAX_PLATFORM_NAME"):
        monkeypatch.delenv(name, raising=False)
    wanted = "devices of 'cuda': no supported devices found for platform CUDA; see what uses them"
    with pytest.raises(ConfigError, match=wanted):
        check_devices()
