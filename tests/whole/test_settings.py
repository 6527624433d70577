"""Settings of a process that are not ours, a few of them; `scripts/fuzz_settings.py` tries all, with every command."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.settings import COMMANDS, SETTINGS, Ending, Setting, fault, run, write_recording

FEW = (
    "none",
    "LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0",
    "<&- >&- 2>&-",
    "PYTHONWARNINGS=error",
    "PYTHONOPTIMIZE=2",
    "MPLBACKEND=module://nothing",
    "JAX_ENABLE_X64=maybe",
    "JAX_PLATFORMS=cuda",
    "XLA_FLAGS=--xla_no_such_flag",
)
"""Each of another kind."""


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW)
def test_a_command_ends_as_it_would_or_names_the_setting(name: str, tmp_path: Path) -> None:
    (setting,) = (each for each in SETTINGS if each.name == name or (name == "none" and not each.name))
    write_recording(tmp_path)
    ending = run(setting, COMMANDS["picture"], tmp_path)
    assert fault(setting, ending) == "", ending.said
    refused = name in ("JAX_ENABLE_X64=maybe", "JAX_PLATFORMS=cuda", "XLA_FLAGS=--xla_no_such_flag")
    assert (ending.code, (tmp_path / "fresh.png").exists()) == ((2, False) if refused else (0, True))


@pytest.mark.parametrize(
    ("ending", "wrong"),
    [
        (Ending(None, "", 240.0), "it hangs"),
        (Ending(1, "Traceback (most recent call last):", 1.0), "a traceback"),
        (Ending(0, "Exception ignored in: <stdout>", 1.0), "a traceback"),
        (Ending(120, "", 1.0), "exit code 120"),
        (Ending(2, "edqn: 'policy' cannot be read", 1.0), "refused for another reason than the setting"),
        (Ending(2, "edqn: JAX_PLATFORMS is 'cuda'", 1.0), ""),
        (Ending(0, "", 1.0), ""),
    ],
)
def test_what_is_a_fault(ending: Ending, wrong: str) -> None:
    assert fault(Setting({"JAX_PLATFORMS": "cuda"}), ending) == wrong
