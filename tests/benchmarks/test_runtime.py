"""The rivals side by side: who takes turns, what is told and kept, and what is said of bad input."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import runtime
from conventional_stack.settings import supported_config
from edqn_jax.config import Config
from edqn_jax.errors import ConfigError
from edqn_jax.sim.scene.mjcf import write_scene
from measurement.child import ChildEndedError
from rivals import stack, table
from rivals.planners.planner import PLANNERS
from tests.support.benchmarks.turns import flights, row, turn
from tests.support.small_worlds import WITHOUT_A_WAY, small_world


@pytest.fixture
def shut(tmp_path: Path) -> Path:
    """A world as a file, from whose start no way leads to its goal."""
    file = tmp_path / "shut.xml"
    write_scene(WITHOUT_A_WAY["wall across"].scene, file, title="shut")
    return file


@pytest.fixture
def clear(tmp_path: Path) -> Path:
    """A small world as a file, with nothing in the way."""
    file = tmp_path / "clear.xml"
    write_scene(small_world().scene, file, title="clear")
    return file


SETTINGS = {"one process": 290.0, "two processes": 300.0}


class Fake:
    """Stands for a child: a method that always arrives."""

    asked: list[tuple[str, str]] = []

    def __init__(self, checkout: Path, script: Path, words: Sequence[str], complaints: Path) -> None:
        self.name, self.file = words[0], Path(words[1])

    def answer(self) -> dict[str, Any]:
        if self.name == "BIT*":
            return {"reason": "ompl is not installed; run pip install 'edqn-jax[bench]'"}
        workload = {"width": 32, "num_envs": 512, "replayed_samples_per_decision": 4, "vae_samples_per_decision": 1}
        return {"device": "a machine", "devices": ["cpu:0"], "versions": {"jax": "0"}, "workload": workload}

    def ask(self, line: str) -> dict[str, Any]:
        if self.name == "APF":
            raise ChildEndedError("Killed")
        if self.name in stack.STEADY:
            return {"decisions_per_second": {"a setting": 9000.0 + int(line)} if "E-DQN" in self.name else SETTINGS}
        self.asked.append((self.name, line))
        outcome, extra = "goal", {}
        if self.name in PLANNERS:
            extra = {"reason": "", "planned_m": 140.0}
        answer = turn(int(line), flights(outcome, **extra))
        del answer["flights"]["shortest_m"]
        return answer

    def __enter__(self) -> Fake:
        return self

    def __exit__(self, *_: object) -> None:
        pass


@pytest.fixture
def faked(monkeypatch: pytest.MonkeyPatch) -> type[Fake]:
    Fake.asked = []
    monkeypatch.setattr(runtime, "Child", Fake)
    return Fake


METHODS = ("E-DQN", "A*", "RRT*", "BIT*", "APF")


@pytest.mark.slow
def test_methods_take_turns_seed_by_seed_and_all_of_it_is_told(
    faked: type[Fake], clear: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, picture = tmp_path / "rows.json", tmp_path / "rows.png"
    words = [
        "--worlds",
        str(clear),
        "--seeds",
        "2",
        "--methods",
        *METHODS,
        "--json",
        str(file),
        "--figure",
        str(picture),
    ]
    assert runtime.main(words) == 0
    assert faked.asked == [(name, seed) for seed in "01" for name in ("E-DQN", "A*", "RRT*")]
    shown, told = capsys.readouterr()
    assert "6,000,000 decisions to train, 20 s to plan" in told and "seed 1 is done" in told
    assert "| E-DQN | no | 40.0 (1,000) | 60.0 | 31.0 | 120 | " in shown
    assert "| RRT*, 5 s | yes | " in shown and "2 of 2: 100% (34% - 100%)" in shown
    assert "- BIT*: ompl is not installed; run pip install 'edqn-jax[bench]'." in shown
    assert "- APF: its process ended in seed 0: Killed." in shown
    # The paper's own figures stand apart and are marked as theirs.
    assert shown.index("Table 3 of the paper") < shown.index("41.364")
    report = json.loads(file.read_text())
    assert [row["name"] for row in report["rows"]] == list(METHODS)
    assert report["workload"]["width"] == 32 and report["device"] == "a machine" and report["versions"]
    assert report["rows"][0]["turns"][1]["curve"] and report["rows"][0]["interval"] == pytest.approx(
        [0.342, 1.0], abs=1e-3
    )
    assert picture.read_bytes().startswith(b"\x89PNG")

    # A seed that was there already is told when all is measured, and what was measured is not lost.
    words[words.index("--seeds") + 1] = "1"
    assert runtime.main([*words, "--add", str(file)]) == 2
    shown_again, told = capsys.readouterr()
    assert "seed 0 of E-DQN on clear.xml occurs twice; the added rows are left out\n" in told
    assert "1 of 1: 100%" in shown_again
    file.write_text(json.dumps(report))

    # The same rows again, read from the file, with another seed beside them; nothing is run for the former.
    assert runtime.main(["--seeds", "0", "--add", str(file)]) == 0
    assert capsys.readouterr().out == shown
    more = ["--worlds", str(clear), "--methods", "E-DQN", "--seeds", "1", "--first-seed", "2", "--add", str(file)]
    assert runtime.main(more) == 0
    assert "3 of 3: 100%" in capsys.readouterr().out


def test_only_methods_that_are_there_are_explained() -> None:
    assert "upper bounds" in table.explain({"E-DQN", "DQN depth"})
    assert "upper bounds" not in table.explain({"E-DQN"}) and "Trains:" in table.explain({"E-DQN"})


def test_a_closed_pipe_costs_no_file_and_a_full_disk_no_table(
    faked: type[Fake], clear: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "rows.json"
    words = ["--worlds", str(clear), "--seeds", "1", "--methods", "A*", "--json", str(file)]

    def closed(rows: object, rates: object) -> str:
        assert file.is_file()
        raise BrokenPipeError

    with monkeypatch.context() as patch:
        patch.setattr(table, "text", closed)
        with pytest.raises(BrokenPipeError):
            runtime.main(words)
    monkeypatch.setattr(runtime, "draw_runtime", lambda rows, picture: (_ for _ in ()).throw(ConfigError("it is full")))
    assert runtime.main([*words, "--figure", str(tmp_path / "rows.png")]) == 2
    shown, told = capsys.readouterr()
    assert "| A* | yes |" in shown and told.endswith("it is full\n")


def test_training_rates_are_taken_in_turns_and_the_best_setting_counts(
    faked: type[Fake], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runtime, "measure_world", lambda asked, world: iter(()))
    file = tmp_path / "rates.json"
    words = ["--quick", "--worlds", "paper", "--methods", "E-DQN", "Conventional stack", "--json", str(file)]
    assert runtime.main(words) == 0
    shown = capsys.readouterr().out
    assert "| E-DQN / Conventional stack, best setting | 30.0 |" in shown
    assert "| Conventional stack, one process | 290 |" in shown
    (rates,) = json.loads(file.read_text())["rates"]
    assert rates["turns"]["E-DQN, a setting"] == [9000.0]
    # Read again they are shown again.
    assert runtime.main(["--seeds", "0", "--add", str(file)]) == 0
    assert capsys.readouterr().out == shown


def test_a_child_that_ends_while_rates_are_taken_is_told_and_the_table_is_still_there(
    faked: type[Fake], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Doomed(Fake):
        def ask(self, line: str) -> dict[str, Any]:
            if self.name in stack.STEADY and line == "1":
                raise ChildEndedError("Killed")
            return super().ask(line)

    monkeypatch.setattr(runtime, "Child", Doomed)
    monkeypatch.setattr(runtime, "measure_world", lambda asked, world: iter([[row("A*", [turn(0, flights("goal"))])]]))
    assert runtime.main(["--worlds", "paper", "--methods", "E-DQN", "Conventional stack"]) == 0
    shown = capsys.readouterr().out
    assert "| A* |" in shown and "- Conventional stack: its process ended in turn 1: Killed." in shown


def test_one_slow_turn_does_not_choose_the_setting_of_the_conventional_stack(monkeypatch: pytest.MonkeyPatch) -> None:
    class Timed(contextlib.ExitStack):
        rates = ((2000.0, 3000.0, 3300.0), (9000.0, 3100.0, 3200.0), (2000.0, 3000.0, 100.0))

        def __init__(self, config: Config, decisions: int) -> None:
            super().__init__()

        def turn(self, number: int) -> dict[str, Any]:
            return {"decisions_per_second": dict(zip("abc", self.rates[number], strict=True))}

    monkeypatch.setattr(stack, "SteadyStack", Timed)
    method = object.__new__(stack.Stack)
    method.config = Config()
    # Medians are 2000, 3000 and 3200; the first turn alone, the best, and the mean would choose others.
    assert method._fastest() == stack.SETTINGS[2]


def test_rates_that_could_not_be_measured_say_why() -> None:
    shown = table.rates_table({"turns": {}, "reason": "Conventional stack: torch is not installed"})
    assert shown.endswith("- Conventional stack: torch is not installed.")


def test_what_has_been_measured_is_on_the_disk_after_each_seed(
    faked: type[Fake], clear: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Doomed(Fake):
        def ask(self, line: str) -> dict[str, Any]:
            if line == "1":
                raise KeyboardInterrupt
            return super().ask(line)

    monkeypatch.setattr(runtime, "Child", Doomed)
    file = tmp_path / "rows.json"
    with pytest.raises(KeyboardInterrupt):
        runtime.main(["--worlds", str(clear), "--seeds", "2", "--methods", "E-DQN", "A*", "--json", str(file)])
    assert [[one["seed"] for one in row["turns"]] for row in json.loads(file.read_text())["rows"]] == [[0], [0]]


def test_quick_is_of_the_papers_world_unless_told_otherwise() -> None:
    quick = runtime.parse(["--quick"])
    assert list(quick.configs) == ["paper"] and quick.words.seeds == 1
    # Both learn it: what is shown of them is what they fly.
    assert quick.configs["paper"].train.total_steps == runtime.parse([]).configs["paper"].train.total_steps
    assert quick.words.methods == ["E-DQN", "DQN blind", *PLANNERS] and len(runtime.parse([]).words.methods) > 10
    assert runtime.parse(["--seeds", "0"]).words.worlds == ["paper", "medium"]
    assert runtime.parse(["--quick", "--seeds", "0", "--worlds", "dense"]).words.worlds == ["dense"]


def test_quick_rows_are_marked(faked: type[Fake], clear: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert runtime.main(["--quick", "--worlds", str(clear), "--methods", "E-DQN", "A*", "Conventional stack"]) == 0
    shown, told = capsys.readouterr()
    assert "1,000,000 decisions to train" in told
    assert "| E-DQN (quick) |" in shown and "| A* |" in shown
    assert "| Conventional stack (quick) | no | 40.0 (1,000) |" in shown


def test_where_there_is_no_way_learners_are_not_trained(
    faked: type[Fake], shut: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert runtime.main(["--worlds", str(shut), "--seeds", "1", "--methods", "E-DQN", "A*"]) == 0
    assert faked.asked == [("A*", "0")]
    assert "- E-DQN: there is no path from start to goal, so train.py rejects this world." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--methods", "A"], "there is no method 'A'; did you mean 'A*'?"),
        (["--worlds", "papper"], "papper"),
        (["--seeds", "-1"], "--seeds must be at least 0, not -1"),
        (["--budget", "0"], "--budget must be a finite number of seconds, more than 0, not 0"),
        (["--budget", "inf"], "--budget must be a finite number of seconds, more than 0, not inf"),
        (["--worlds", "a/w.xml", "b/w.xml"], "'a/w.xml' and 'b/w.xml' would have rows of the same name"),
        (["--figure", "rows.pdf"], "--figure must end in .png, not 'rows.pdf'"),
        (["--json", "no/such/folder/file.json"], "there is no folder"),
        (["--add", "no_such_file.json"], "'no_such_file.json' cannot be read: No such file"),
        (["--seeds", "0", "--add", __file__], "is not a report of this benchmark"),
        (["--worlds", "paper", "--", "--num-envs", "7"], "train.num_envs"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(
    words: list[str], message: str, faked: type[Fake], capsys: pytest.CaptureFixture[str]
) -> None:
    assert runtime.main(words) == 2
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1
    assert not faked.asked


@pytest.mark.parametrize("report", [{}, {"rows": []}, {"rows": {}, "rates": []}])
def test_a_report_without_rows_is_none_of_this_benchmark(
    report: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "rows.json"
    file.write_text(json.dumps({"benchmark": "runtime", **report}))
    assert runtime.main(["--seeds", "0", "--add", str(file)]) == 2
    assert capsys.readouterr().err == f"'{file}' is not a report of this benchmark\n"


@pytest.mark.slow
def test_rows_with_other_options_are_other_rows(clear: Path) -> None:
    def settings(name: str, *flags: str) -> dict[str, Any]:
        return runtime.blank(runtime.parse(["--worlds", str(clear), "--", *flags]), str(clear), name)["settings"]

    body, agent = ("--drone.body-radius-m", "0.3"), ("--agent.learning-rate", "0.003")
    for name in ("A*", "E-DQN"):
        assert settings(name) == settings(name)
        assert settings(name, *body) != settings(name)
        assert settings(name, "--env.goal-radius-m", "3.0") != settings(name)
    assert settings("E-DQN", *agent) != settings("E-DQN")
    assert settings("A*", *agent) == settings("A*")  # it has none


def test_rivals_are_judged_in_test_worlds_and_timed_in_the_papers() -> None:
    assert runtime.config_for_world("medium", [], quick=True).world.flown == ""
    assert runtime.for_timing([]).world.name == "paper"
    assert runtime.for_timing(["--world", "medium"]).world.flown == ""


def test_the_conventional_stack_has_its_own_agent_unless_told_otherwise() -> None:
    ours = Config()
    theirs = supported_config(ours).agent
    assert (theirs.history, theirs.huber_delta) == (1, 1.0) and theirs.hidden == ours.agent.hidden
    told = dataclasses.replace(ours, agent=dataclasses.replace(ours.agent, learning_rate=5e-4))
    assert supported_config(told).agent.learning_rate == 5e-4


def test_the_script_states_its_length(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ending:
        runtime.parse(["--help"])
    assert ending.value.code == 0
    assert "hours on two cores" in " ".join(capsys.readouterr().out.split())
