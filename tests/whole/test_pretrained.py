"""The policy that comes with the package: found by its name, small, described, and able to fly."""

from __future__ import annotations

import dataclasses
import json
import re
from importlib import import_module
from pathlib import Path

import pytest

import edqn_jax
from edqn_jax.cli.train import parse_train
from edqn_jax.policies import BODY, LATE, LOOKS, PRETRAINED, SHIPPED, policy_folder
from edqn_jax.runs.directory import version_of

FOLDER = policy_folder(Path(PRETRAINED))

KINDS = {PRETRAINED: "plaid", LOOKS: "autopilot", LATE: "late", BODY: "body"}
"""Of `scripts/pretrain.py`."""


@pytest.mark.parametrize("name", SHIPPED)
def test_it_is_small_has_no_pickle_and_says_who_wrote_it(name: str) -> None:
    folder = policy_folder(Path(name))
    files = [file for file in folder.rglob("*") if file.is_file()]
    assert files and sum(file.stat().st_size for file in files) < 13e6
    # A pickle of protocol 2 or later begins with 0x80 and its protocol.
    assert not [file for file in files if file.read_bytes()[:2] in (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")]
    assert version_of(folder / "config.yaml") is not None


def test_a_folder_of_that_name_goes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert policy_folder(Path(PRETRAINED)) == FOLDER
    (tmp_path / PRETRAINED).mkdir()
    assert policy_folder(Path(PRETRAINED)) == Path(PRETRAINED)
    assert policy_folder(Path("runs/other")) == Path("runs/other")


def test_its_card_tells_of_its_training() -> None:
    card, config = (FOLDER / "README.md").read_text(), edqn_jax.load_policy(PRETRAINED).config
    assert f"{config.train.total_steps:,} decisions" in card and f"| seed | {config.train.seed}, " in card
    assert (
        f"{config.world.pool_size:,} worlds (`--world mixed --surface.pattern plaid`" in card
        and config.world.name == "mixed"
    )
    for family in ("sparse", "medium", "dense", "rooms", "forest", "canyon"):
        assert re.search(rf"^\| {family} \| 1000 \| (9\d|100)\.\d% \| ", card, re.MULTILINE), family


def test_the_card_of_the_policy_of_any_look_has_a_row_for_each_look_and_family() -> None:
    card, config = (policy_folder(Path(LOOKS)) / "README.md").read_text(), edqn_jax.load_policy(LOOKS).config
    assert f"{config.train.total_steps:,}" in card and config.surface.pattern == "drawn"
    for look in ("drawn", "blank", "bricks", "posters", "wood"):
        assert re.search(rf"^\| `{look}` (\| \d+\.\d( \([\d.–]+\))? ){{6}}\|$", card, re.MULTILINE), look


def test_saved_files_name_no_folder_of_the_computer_that_wrote_them(tmp_path: Path) -> None:
    edqn_jax.save_policy(edqn_jax.load_policy(PRETRAINED), tmp_path / "mine")
    for folder, path in ((tmp_path, str(tmp_path).encode()), (FOLDER, b".partial")):
        assert not [file for file in folder.rglob("*") if file.is_file() and path in file.read_bytes()]


def test_a_near_miss_of_its_name_is_answered_with_it(tmp_path: Path) -> None:
    with pytest.raises(edqn_jax.ConfigError, match="no run in 'pretraind': did you mean 'pretrained'"):
        edqn_jax.load_policy("pretraind")
    with pytest.raises(edqn_jax.ConfigError, match="it holds no config.yaml"):
        edqn_jax.load_policy(tmp_path)


@pytest.mark.parametrize("name", SHIPPED)
def test_its_script_trains_with_its_options(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "scripts"))
    options = edqn_jax.load_policy(name).config
    script = import_module("pretrain")
    words = script.options_of(options.world.name, KINDS[name])
    _, asked = parse_train(words)
    if name != PRETRAINED:  # began with a policy of any look
        assert parse_train([*words, "--start-from", LOOKS])[1] == asked
    # Where it ran and how often it saved say nothing of what was learnt.
    elsewhere = {
        name: getattr(options.train, name) for name in ("seed", "devices", "checkpoint_every_s", "checkpoints")
    }
    assert dataclasses.replace(asked, train=dataclasses.replace(asked.train, **elsewhere)) == options
    assert len(script.families_of(edqn_jax.load_policy(name))) == 6
    for world in script.DECISIONS:
        assert parse_train(script.options_of(world))[1].world.name == world


def test_the_kind_late_is_that_of_the_autopilot_with_moves_that_are_late_in_half_of_the_episodes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "scripts"))
    script = import_module("pretrain")
    begin = ["--start-from", LOOKS]
    autopilot, late = (parse_train([*script.options_of("narrow", kind), *begin])[1] for kind in ("autopilot", "late"))
    assert (late.env.action_delay, late.env.delay_share, late.agent.last_move) == (1, 0.5, True)
    env = dataclasses.replace(autopilot.env, action_delay=1, delay_share=0.5)
    agent, train = dataclasses.replace(autopilot.agent, last_move=True), late.train
    assert late == dataclasses.replace(autopilot, env=env, agent=agent, train=train)


def test_the_best_seed_is_that_of_the_validation_worlds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "scripts"))
    best_of = import_module("pretrain").best_of
    with pytest.raises(edqn_jax.ConfigError, match="holds 0 finished seeds of 5"):
        best_of(tmp_path)
    for seed, success, spl in ((0, 0.98, 0.99), (1, 0.99, 0.90), (2, 0.99, 0.91), (3, 0.97, 1.0), (4, 0.9, 0.9)):
        run = tmp_path / f"seed-{seed}"
        run.mkdir()
        test = {"success_rate": 1.0 - success}  # has no say
        (run / "summary.json").write_text(
            json.dumps({"validation_success": success, "validation_spl": spl, "test": test})
        )
    assert best_of(tmp_path).name == "seed-2"


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.slow
def test_it_flies_the_papers_world_which_it_was_not_trained_on(name: str) -> None:
    policy = edqn_jax.load_policy(name)
    figures = edqn_jax.evaluate(policy, "paper").figures
    assert figures["success_rate"] == 1.0 and figures["decisions"] <= 188
    assert figures["min_clearance_m"] >= 1.5 * policy.config.drone.body_radius_m
