"""`scripts/pretrain.py`: the card that each kind of policy gets, from evaluations that say what they were asked."""

from __future__ import annotations

import dataclasses
import json
import re
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from edqn_jax.cli.train import parse_train
from edqn_jax.config import EXACT, MIXTURES, Config
from edqn_jax.config.simulation import LOOKS
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.evaluate import Evaluation
from edqn_jax.learn.policy import Policy, fresh_policy
from edqn_jax.runs.policies import load_policy, save_policy
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.worlds.looks import TRAINED
from tests.support.policies import CONFIG

FAMILIES = tuple(MIXTURES["narrow"])


@pytest.fixture
def pretrain(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "scripts"))
    script = import_module("pretrain")
    monkeypatch.setattr(script, "use_cpu_devices", lambda: None)  # the tests have devices already
    return script


def small(config: Config) -> Config:
    """A configuration with networks that take no time to make."""
    return dataclasses.replace(
        config,
        drone=CONFIG.drone,
        camera=dataclasses.replace(config.camera, width=8, height=6),
        encoder=dataclasses.replace(config.encoder, patch_layers=(8, 4), joint_layers=(16,), decoder_hidden=(16,)),
        agent=dataclasses.replace(config.agent, hidden=(16,)),
    )


def write_seeds(script: ModuleType, folder: Path, world: str, kind: str, seeds: dict[int, float]) -> Config:
    """Writes runs of a kind as train.py leaves them, untrained, with what they reached in validation."""
    config = small(parse_train(script.options_of(world, kind))[1])
    for seed, reached in seeds.items():
        own = dataclasses.replace(config, train=dataclasses.replace(config.train, seed=seed))
        run = folder / f"seed-{seed}"
        save_policy(Policy(own, fresh_policy(own, seed)), run)
        summary = {"validation_success": reached, "validation_spl": 0.8, "train_seconds": 612.3, "compile_seconds": 70}
        (run / "summary.json").write_text(json.dumps({**summary, "devices": ["cuda:0 (NVIDIA H200)"]}))
    return config


def evaluation(successes: int, missions: int, **more: Any) -> Evaluation:
    """An evaluation of flights of which the others collide, and of which the i-th keeps i / 10 metres."""
    outcome = np.where(np.arange(missions) < successes, Outcome.GOAL, Outcome.COLLISION)
    figures = {
        **{
            "missions": missions,
            "successes": successes,
            "success_rate": successes / missions,
            "interval": [0.25, 0.75],
        },
        **{"collisions": missions - successes, "left_volume": 0, "timeouts": 0, "diverged": 0, "spl": 0.5},
        **{"decisions": 100.0, "path_length_m": 120.0, "path_over_shortest": 1.1, "min_clearance_m": 0.72},
        "decoder": {"near_m": 10.0, "relative_median": successes / 100, "relative_p90": None},
    }
    flights = SimpleNamespace(outcome=outcome, closest=SimpleNamespace(distance=np.arange(missions) / 10))
    return Evaluation(SimpleNamespace(), flights, {**figures, **more})  # pyright: ignore[reportArgumentType]


@pytest.fixture
def asked(pretrain: ModuleType, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """What was flown: world, look, missions, seed and whether without disturbances."""
    found = []

    def evaluate(policy: Policy, world: str, *, missions: int = 1, seed: int = 0, conditions: Any = None) -> Evaluation:
        found.append((world, None, missions, seed, conditions == EXACT))
        return evaluation(1 if world == "paper" else missions // 2, missions)

    def evaluate_look(policy: Policy, world: str, look: str, *, missions: int, seed: int, exact: bool) -> Evaluation:
        found.append((world, look, missions, seed, exact))
        return evaluation(LOOKS.index(look) + FAMILIES.index(world) + 3, missions)

    monkeypatch.setattr(pretrain, "evaluate", evaluate)
    monkeypatch.setattr(pretrain, "evaluate_look", evaluate_look)
    return found


def make(script: ModuleType, tmp_path: Path, kind: str, *more: str, world: str = "narrow") -> str:
    """Returns the card that the script writes of the runs in `tmp_path / "run"`."""
    begin = [] if kind in ("plaid", "looks") else ["--start-from", "runs/first"]
    words = ["--kind", kind, "--world", world, "--run", str(tmp_path / "run"), "--commit", "abc1234", *begin, *more]
    assert script.main([*words, "--out", str(tmp_path / "out")]) == 0
    return (tmp_path / "out" / "README.md").read_text()


def cells(card: str, row: str) -> list[list[str]]:
    """Returns the cells of every row of a card's tables that begins with a word."""
    return [line.strip("| ").split(" | ")[1:] for line in card.splitlines() if line.startswith(f"| {row} |")]


@pytest.mark.parametrize("kind", ["looks", "further", "autopilot", "late", "body"])
def test_a_policy_of_any_look_has_a_row_for_each_look_and_a_column_for_each_family(
    kind: str, pretrain: ModuleType, tmp_path: Path, asked: list[tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = write_seeds(pretrain, tmp_path / "run", "narrow", kind, {7: 0.9, 8: 0.95, 9: 0.9})
    card = make(pretrain, Path(), kind, "--seeds", "3", "--missions", "20")
    assert load_policy(tmp_path / "out").config.train.seed == 8
    assert cells(card, "look") == [list(FAMILIES)] * 2
    for row, look in enumerate(LOOKS):
        success, error = cells(card, f"`{look}`")
        numbers = [row + column + 3 for column in range(len(FAMILIES))]
        assert success == [f"{5 * number:.1f} (25.0–75.0)" for number in numbers]
        assert error == [f"{number}%, –" for number in numbers]
    paper, flown = asked[:3], asked[3:]
    assert paper == [("paper", None, 1, 0, True)] * 3
    assert flown == [(family, look, 20, 11, True) for look in LOOKS for family in FAMILIES]
    assert cells(card, "seed") == [["8, the best of 3 in 64 validation worlds (7: 90.0%, 8: 95.0%, 9: 90.0%)"]]
    assert "612 s, and 70 s of compiling, on cuda:0 (NVIDIA H200)" in card
    assert f"{config.train.total_steps:,} decisions in 16,384 environments" in card
    assert "Never trained on: `plaid`, `bricks`, `posters`, `wood`." in card and "sparse 1, " in card
    assert not set(re.findall(r"Never trained on: (.*)\.", card)[0].strip("`").split("`, `")) & TRAINED.keys()
    # Those that arrive in sparse worlds of look drawn are the first 4 of 20.
    assert "Half of the `drawn` flights that arrive keep at least, metres from all: 0.15 in sparse, 0.20 in" in card
    assert ("from `runs/first`" in card) == (kind != "looks")


@pytest.mark.parametrize(
    ("kind", "sees"),
    [
        ("looks", "own state and motion, the"),
        ("late", "own state, motion and last move, the"),
        ("body", "at each frame, the"),
    ],
)
def test_the_card_says_what_a_policy_was_trained_with(
    kind: str, sees: str, pretrain: ModuleType, tmp_path: Path, asked: list[tuple[Any, ...]]
) -> None:
    write_seeds(pretrain, tmp_path / "run", "narrow", kind, {0: 0.9})
    card = make(pretrain, tmp_path, kind, "--seeds", "1", "--looks", "wood", "--missions", "20")
    body = kind == "body"
    (seen,), (camera,), (sensor,), (errors,) = (
        row for what in ("sees", "camera", "sensor", "errors of tracking") for row in cells(card, what)
    )
    assert seen.startswith("events of 2 windows of 0.08 s") and f"{sees} contrast of its sensor" in seen
    assert ("moved to where a level camera" in seen) == body == camera.startswith("on the body, 8 x 6 pixels, 90 deg")
    assert "117 pixels" in sensor and "contrast 0.02 to 0.3" in sensor and "`dvs`, 0 to 100 %" in sensor
    assert (
        "drag, mass off by up to 20%, thrust of each rotor off by up to 20%, motors that lag by up to 0.05 s" in errors
    )
    assert ("changes by 4 m/s² or more in 75% of the episodes" in errors) == (kind != "looks")
    assert ("a delay of one decision in 50% of the episodes" in errors) == (kind == "late")
    assert cells(card, "closeness") == [["costs 0.25 within 0.6 m (`env.closeness_weight`)"]]
    assert ("A level camera" in card) != body
    assert cells(card, "seed") == [["0, the only one in 64 validation worlds (0: 90.0%)"]]
    assert "One training seed: how much another would differ is not known." in card
    begin = "" if kind == "looks" else " --start-from runs/first"
    assert f"`scripts/pretrain.py --kind {kind} --world narrow{begin} --seeds 1 --first-seed 0`" in card
    assert {look for _, look, *_ in asked} == {None, "wood"}
    for place in pretrain.model_card.PLACES:
        assert re.search(rf"^### {place}\n\nNot measured: `", card, re.MULTILINE), place
    assert "{" not in card


def test_what_other_commands_measured_stays_when_a_card_is_made_anew(
    pretrain: ModuleType, tmp_path: Path, asked: list[tuple[Any, ...]]
) -> None:
    write_seeds(pretrain, tmp_path / "run", "narrow", "looks", {0: 0.9})
    file = tmp_path / "measured.md"
    file.write_text(
        "Two cores.\n\n### Verdicts\n\nAll of 1,200 agree.\n\n### Light\n\n| lux | % |\n\n### Limits\n\n- Not in fog.\n"
    )
    words = ["--seeds", "1", "--looks", "drawn", "--missions", "20", "--measured", str(file)]
    card = make(pretrain, tmp_path, "looks", *words)
    assert make(pretrain, tmp_path, "looks", *words) == card
    headings = re.findall(r"^##+ (.*)$", card, re.MULTILINE)
    assert headings == ["Measured", *pretrain.model_card.PLACES, "Light", "Limits"]
    assert "### Verdicts\n\nAll of 1,200 agree.\n\n### Outer test\n\nNot measured: `" in card
    assert card.index("paper's own map") < card.index("\n\nTwo cores.\n\n### True depth") and "| lux | % |" in card
    assert card.endswith("must not be.\n- Not in fog.\n")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# Verdicts\n\nAll agree.\n", "headings of the third level, such as '### Verdicts', not '# Verdicts'"),
        ("### Verdicts\n\n### Light\n\nDark.\n", "'### Verdicts' of the measurements must stand once, with text"),
        ("### Light\n\nA.\n\n### Light\n\nB.\n", "'### Light' of the measurements must stand once"),
        ("\n", "the file of measurements is empty"),
        (None, "cannot be read"),
    ],
)
def test_measurements_that_a_card_cannot_take_are_refused_before_anything_is_flown(
    text: str | None, message: str, pretrain: ModuleType, tmp_path: Path, asked: list[tuple[Any, ...]], capsys
) -> None:
    file = tmp_path / "measured.md"
    if text is not None:
        file.write_text(text)
    (tmp_path / "run").mkdir()
    words = ["--kind", "looks", "--run", str(tmp_path / "run"), "--out", str(tmp_path / "out"), "--commit", "abc1234"]
    assert pretrain.main([*words, "--measured", str(file)]) == 2
    assert message in capsys.readouterr().err and not asked and not (tmp_path / "out").exists()


def test_a_policy_of_one_plaid_has_a_row_for_each_family(
    pretrain: ModuleType, tmp_path: Path, asked: list[tuple[Any, ...]]
) -> None:
    write_seeds(pretrain, tmp_path / "run", "mixed", "plaid", {0: 0.98, 1: 0.99})
    card = make(pretrain, tmp_path, "plaid", "--seeds", "2", "--missions", "20", world="mixed")
    assert load_policy(tmp_path / "out").config.train.seed == 1
    for family in MIXTURES["mixed"]:
        assert cells(card, family) == [["20", "50.0%", "25.0% to 75.0%", "0.500", "10", "0"]]
    assert asked[2:] == [(family, None, 20, 0, False) for family in MIXTURES["mixed"]]
    assert cells(card, "sees") == [["events of the last 0.08 s (threshold 0.03), its own state and motion"]]
    assert "- The best of 2 training seeds, of which 2 reach the goal of the paper's map." in card
    assert cells(card, "sensor") == cells(card, "errors of tracking") == [] and "{" not in card


def test_every_finished_seed_counts(pretrain: ModuleType, tmp_path: Path) -> None:
    for seed in (2, 10):
        (tmp_path / f"seed-{seed}").mkdir()
        (tmp_path / f"seed-{seed}" / "summary.json").write_text("{}")
    assert [run.name for run in pretrain.seeds_of(tmp_path, 2)] == ["seed-2", "seed-10"]
    with pytest.raises(ConfigError, match="holds 2 finished seeds of 5; continue it"):
        pretrain.seeds_of(tmp_path)
    with pytest.raises(ConfigError, match="holds 2 finished seeds; give --seeds 2"):
        pretrain.seeds_of(tmp_path, 1)


def test_as_many_seeds_are_trained_as_are_asked_for(
    pretrain: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = []
    monkeypatch.setattr(
        pretrain.subprocess, "run", lambda words: started.append(words) or SimpleNamespace(returncode=1)
    )
    words = ["--kind", "looks", "--run", str(tmp_path / "run"), "--out", str(tmp_path / "out")]
    assert pretrain.main([*words, "--seeds", "1", "--first-seed", "33"]) == 2
    _, config = (options := parse_train(started[0][2:]))
    assert options[0].seeds == 1 and config.train.seed == 33 and config.surface.pattern == "drawn"


@pytest.mark.parametrize(
    "words",
    [
        ["--seeds", "0"],
        ["--missions", "0"],
        ["--looks", "drawn"],
        ["--measured", "a.md"],
        ["--kind", "looks", "--looks", "brick"],
        ["--kind", "body"],
        ["--kind", "late"],
        ["--kind", "looks", "--start-from", "runs/first"],
    ],
)
def test_options_that_do_not_go_together_are_refused(words: list[str], pretrain: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        pretrain.parse(["--run", str(tmp_path / "run"), "--out", str(tmp_path / "out"), *words])
    assert ended.value.code == 2


@pytest.mark.slow
def test_a_card_is_made_of_real_flights(pretrain: ModuleType, tmp_path: Path) -> None:
    write_seeds(pretrain, tmp_path / "run", "open", "looks", {0: 0.5})
    words = ["--seeds", "1", "--missions", "2", "--looks", "wood", "--test-seed", "5"]
    card = make(pretrain, tmp_path, "looks", *words, world="open")
    success, error = cells(card, "`wood`")
    assert len(success) == len(error) == 3 and all(re.fullmatch(r"(\d+%|–), (\d+%|–)", cell) for cell in error)
    assert "--missions 2 --seed 5 --exact" in card
