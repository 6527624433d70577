"""The rivals side by side: who takes turns, what rows come to, and what is said where a method is not there."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import multiprocessing
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import learners
import planning
import resident
import rival
import rows
import runtime
import runtime_table
import stack
from child import Child, ChildEndedError
from edqn_jax.baselines.planner import PLANNERS
from edqn_jax.cli import parse_train
from edqn_jax.config import Config, ConfigError
from edqn_jax.resolve import to_yaml
from edqn_jax.sim.mjcf import write_scene
from tests.baselines.rooms import WITHOUT_A_WAY, room
from tests.baselines.uninstalled import hide
from tests.miniature import MINIATURE

TINY = (*MINIATURE, "--total-steps", "512", "--train.chunk-steps", "8", "--train.validation-every", "256")


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
    write_scene(room().scene, file, title="clear")
    return file


def flights(*outcomes: str, **changes: Any) -> dict[str, list[Any]]:
    """Flights that ended so, each of them otherwise alike."""
    alike = {
        "decisions": 120,
        "flight_seconds": 31.0,
        "path_length_m": 130.0,
        "clearance_m": 0.5,
        "planning_seconds": 0.06,
        "shortest_m": 125.0,
        **changes,
    }
    return {"outcome": list(outcomes), **{key: [value] * len(outcomes) for key, value in alike.items()}}


def turn(seed: int, flown: dict[str, list[Any]], seconds: float = 40.0, **changes: Any) -> dict[str, Any]:
    """A learner's turn, with one point in the middle of its curve, by when nothing was flown."""
    bits = "".join("01"[outcome == "goal"] for outcome in flown["outcome"])
    curve = [
        {"decisions": 500, "seconds": seconds / 2, "validation_success": 0.25, "test": "0" * len(bits)},
        {"decisions": 1000, "seconds": seconds, "validation_success": 0.5, "test": bits},
    ]
    since = {"first_success_decisions": 1000, "first_success_seconds": seconds}
    memory = {"peak_bytes": 10**9, "device_peak_bytes": None}
    return {"seed": seed, "decisions": 1000, "train_seconds": seconds, **since, "curve": curve, "flights": flown} | (
        memory | changes
    )


def row(name: str, turns: Sequence[dict[str, Any]], world: str = "medium", **changes: Any) -> dict[str, Any]:
    kind = "planner" if name in PLANNERS else "learner"
    own = {"settings": {"quick": False, "budget_seconds": 5.0}, "device": "a machine", "reason": None}
    return {"name": name, "world": world, "kind": kind, "knows_map": kind == "planner", "turns": list(turns)} | (
        own | {"devices": [], "versions": {}, "workload": {"width": 32}} | changes
    )


# --------------------------------------------------------------------------------------------- rows


def test_figures_are_of_flights_that_arrived_and_success_is_of_all() -> None:
    first = turn(0, flights("goal", "collision", "goal"))
    first["flights"]["flight_seconds"] = [30.0, 1.0, 34.0]
    first["flights"]["clearance_m"] = [0.4, -0.1, 0.7]
    shown = rows.figures(row("E-DQN", [first, turn(1, flights("goal", "goal", "goal"), 60.0)]))
    assert (shown["successes"], shown["flights"]) == (5, 6)
    assert shown["flight_seconds"] == statistics.median([30.0, 34.0, 31.0, 31.0, 31.0])
    assert shown["clearance_m"] == 0.4
    assert shown["path_over_shortest"] == pytest.approx(1.04)
    assert shown["train_seconds"] == 50.0 and shown["peak_bytes"] == 10**9


def test_most_seeds_that_never_fly_make_the_training_time_never() -> None:
    never: dict[str, Any] = {"first_success_seconds": None, "first_success_decisions": None}
    some = [turn(0, flights("goal")), turn(1, flights("goal")), turn(2, flights("collision"), **never)]
    assert rows.figures(row("E-DQN", some))["train_seconds"] == 40.0
    lost = row("E-DQN", [some[0], turn(1, flights("collision"), **never), some[2]])
    assert rows.figures(lost)["train_seconds"] is None
    assert "| never |" in runtime_table.methods([lost])


def test_a_planner_that_draws_nothing_counts_once_but_is_timed_every_time() -> None:
    turns = [turn(seed, flights("goal", planning_seconds=float(seed), planned_m=130.0)) for seed in (1, 2, 3)]
    certain, drawing = rows.figures(row("A*", turns, "paper")), rows.figures(row("RRT*", turns, "paper"))
    assert (certain["flights"], drawing["flights"]) == (1, 3)
    assert certain["planning_seconds"] == drawing["planning_seconds"] == 2.0


def test_rows_of_several_files_become_one_with_the_seeds_of_all() -> None:
    parts = [row("E-DQN", [turn(seed, flights("goal", "goal"))]) for seed in (0, 1)]
    elsewhere = row("E-DQN", [turn(0, flights("goal", "goal"))], device="another machine")
    joined = rows.joined([*parts, elsewhere])
    assert [[one["seed"] for one in row["turns"]] for row in joined] == [[0, 1], [0]]
    assert len(parts[0]["turns"]) == 1  # what was read stays as it was
    with pytest.raises(ConfigError, match="seed 0 of E-DQN on medium is there twice"):
        rows.joined([parts[0], parts[0]])


def test_a_row_that_could_not_run_gives_way_to_one_that_ran_elsewhere() -> None:
    missing = row("A*", [], device=None, reason="numba is not installed")
    assert rows.joined([missing, row("SNN", [])]) == [missing, row("SNN", [])]
    ran = row("A*", [turn(0, flights("goal"))])
    assert rows.joined([missing, ran]) == [ran]


def test_events_are_worth_what_flies_at_equal_decisions_and_at_equal_wall_time() -> None:
    mixed = flights("goal", "goal", "collision", "goal")
    fast = row(
        "DQN blind", [turn(seed, flights("goal", "collision", "collision", "collision"), 10.0) for seed in (0, 1)]
    )
    slow = row("E-DQN", [turn(seed, mixed, 18.0) for seed in (0, 1, 2)])
    (one,) = rows.worth([slow, fast, row("A*", [turn(0, mixed)])])
    assert (one.seconds, one.decisions) == (10.0, 1000)
    ours, blind = one.rates
    assert (ours["name"], ours["seeds"], ours["at_decisions"]["rate"]) == ("E-DQN", 3, 0.75)
    # After 10 s it has what it had kept after 9 s: nothing that flies.
    assert ours["at_seconds"]["rate"] == 0.0 and blind["at_seconds"]["rate"] == 0.25
    (less,) = one.differences
    assert less["name"] == "DQN blind"
    assert (less["at_decisions"]["difference"], less["at_seconds"]["difference"]) == (0.5, -0.25)
    low, high = less["at_decisions"]["interval"]
    assert 0.0 <= low < 0.5 < high <= 1.0
    shown = runtime_table.worth_table(one)
    assert "10.0 s of training" in shown and "| E-DQN less DQN blind | | +50.0 % (" in shown


def test_before_its_first_validation_a_learner_has_nothing() -> None:
    learner = row("E-DQN", [turn(0, flights("goal", "goal"), 18.0)])
    assert not rows.kept_by(learner, 8.9).any()
    assert rows.kept_by(learner, 18.0).all()


def test_learners_of_other_devices_or_budgets_are_not_compared() -> None:
    many = [turn(0, flights("goal", "collision"))]
    assert not rows.worth([row("E-DQN", many), row("DQN blind", many, device="another machine")])
    assert not rows.worth([row("E-DQN", many), row("DQN blind", many, settings={"quick": True})])
    assert not rows.worth([row(name, [turn(0, flights("goal"))], "paper") for name in ("E-DQN", "DQN blind")])


# ---------------------------------------------------------------------------------------- in turns


SETTINGS = {"one process": 290.0, "two processes": 300.0}


class Fake:
    """Stands for a child: a method that always arrives."""

    asked: list[tuple[str, str]] = []

    def __init__(self, checkout: Path, script: Path, words: Sequence[str], complaints: Path) -> None:
        self.name, self.file = words[0], Path(words[1])

    def answer(self) -> dict[str, Any]:
        if self.name == "BIT*":
            return {"reason": "ompl is not installed; pip install 'edqn-jax[bench]' brings it"}
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
    assert "1,000,000 decisions to train, 20 s to plan" in told and "seed 1 is done" in told
    assert "| E-DQN | no | 40.0 (1,000) | 60.0 | 31.0 | 120 | " in shown
    assert "2 of 2: 100% (34% - 100%)" in shown
    assert "- BIT*: ompl is not installed; pip install 'edqn-jax[bench]' brings it." in shown
    assert "- APF: it ended in seed 0: Killed." in shown
    # The paper's own figures stand apart and are marked as theirs.
    assert shown.index("Table 3 (theirs)") < shown.index("41.364")
    report = json.loads(file.read_text())
    assert [row["name"] for row in report["rows"]] == list(METHODS)
    assert report["workload"]["width"] == 32 and report["device"] == "a machine" and report["versions"]
    assert report["rows"][0]["turns"][1]["curve"] and report["rows"][0]["interval"] == pytest.approx(
        [0.342, 1.0], abs=1e-3
    )
    assert picture.read_bytes().startswith(b"\x89PNG")

    # The same rows again, read from the file, with another seed beside them; nothing is run for the former.
    assert runtime.main(["--seeds", "0", "--add", str(file)]) == 0
    assert capsys.readouterr().out == shown
    more = ["--worlds", str(clear), "--methods", "E-DQN", "--seeds", "1", "--first-seed", "2", "--add", str(file)]
    assert runtime.main(more) == 0
    assert "3 of 3: 100%" in capsys.readouterr().out


def test_training_rates_are_taken_in_turns_and_the_best_setting_counts(
    faked: type[Fake], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runtime, "measure_world", lambda asked, world: iter(()))
    file = tmp_path / "rates.json"
    words = ["--quick", "--worlds", "paper", "--methods", "E-DQN", "Conventional stack", "--json", str(file)]
    assert runtime.main(words) == 0
    shown = capsys.readouterr().out
    assert "| E-DQN / Conventional stack, its best | 30.0 |" in shown
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
    assert "| A* |" in shown and "- Conventional stack: it ended in turn 1: Killed." in shown


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
    shown = runtime_table.rates_table({"turns": {}, "reason": "Conventional stack: torch is not installed"})
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


def test_quick_rows_are_marked_as_not_converged(
    faked: type[Fake], clear: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert runtime.main(["--quick", "--worlds", str(clear), "--methods", "E-DQN", "A*", "Conventional stack"]) == 0
    shown, told = capsys.readouterr()
    assert "240,000 decisions to train" in told
    assert "| E-DQN (not converged) |" in shown and "| A* |" in shown
    assert "| Conventional stack (not converged) | no | 40.0 (1,000) |" in shown


def test_where_there_is_no_way_learners_are_not_trained(
    faked: type[Fake], shut: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert runtime.main(["--worlds", str(shut), "--seeds", "1", "--methods", "E-DQN", "A*"]) == 0
    assert faked.asked == [("A*", "0")]
    assert "- E-DQN: there is no way from start to goal, so train.py refuses this world." in capsys.readouterr().out


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
        (["--seeds", "0", "--add", __file__], "holds no rows of this benchmark"),
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
    assert capsys.readouterr().err == f"'{file}' holds no rows of this benchmark\n"


def test_rows_of_other_knobs_are_other_rows(clear: Path) -> None:
    def settings(name: str, *flags: str) -> dict[str, Any]:
        return runtime.blank(runtime.parse(["--worlds", str(clear), "--", *flags]), str(clear), name)["settings"]

    body, agent = ("--drone.body-radius-m", "0.3"), ("--agent.learning-rate", "0.003")
    for name in ("A*", "E-DQN"):
        assert settings(name) == settings(name)
        assert settings(name, *body) != settings(name)
        assert settings(name, "--env.goal-radius-m", "3.0") != settings(name)
    assert settings("E-DQN", *agent) != settings("E-DQN")
    assert settings("A*", *agent) == settings("A*")  # it has none


def test_the_script_states_its_length(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ending:
        runtime.parse(["--help"])
    assert ending.value.code == 0
    assert "hours on two cores" in " ".join(capsys.readouterr().out.split())


# -------------------------------------------------------------------------------------- the methods


def answers_of(name: str, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: str) -> list[Any]:
    """What the child of a method says, run in this process."""
    file = tmp_path / "config.yaml"
    file.write_text(to_yaml(config))
    monkeypatch.setattr(sys, "argv", ["rival.py", name, str(file), "1.0", "1"])
    monkeypatch.setattr(sys, "stdin", io.StringIO(asked))
    monkeypatch.setattr(rival, "use_cpu_devices", lambda: None)
    stream = io.StringIO()
    rival.main(stream)
    return [json.loads(line) for line in stream.getvalue().splitlines()]


@pytest.mark.parametrize("name", ["RRT*", "Conventional stack", "Conventional stack, steady"])
def test_a_missing_package_is_a_reason(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hide(monkeypatch, "numba", "ompl")
    (said,) = answers_of(name, parse_train(MINIATURE)[1], tmp_path, monkeypatch, "0\n")
    assert said == {"reason": "numba is not installed; pip install 'edqn-jax[bench]' brings it"}


def test_a_planner_says_no_path_where_there_is_none(
    shut: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, config = parse_train(["--world", str(shut)])
    about, *turns = answers_of("SNN", config, tmp_path, monkeypatch, "0\n1\n")
    assert about["workload"]["obstacles"] == 1 and about["device"]
    assert [turn["seed"] for turn in turns] == [0, 1]
    for one in turns:
        assert one["flights"]["outcome"] == ["no_path"]
        assert one["flights"]["reason"][0].startswith("no path")
        assert one["peak_bytes"] > 10**7
        one["flights"]["shortest_m"] = [None]
    shown = runtime_table.methods([row("SNN", turns, "shut.xml")])
    assert "| 0 of 1: 0% (" in shown and "- SNN: no path: the wave does not reach the start." in shown


@pytest.mark.slow
def test_the_judged_worlds_are_those_that_training_ends_with() -> None:
    _, config = parse_train(["--world", "medium", *MINIATURE, "--world.pool-size", "4"])
    scenes = planning.judged_scenes(config, 2)
    final = learners.lay_courses(config).final
    for index, scene in enumerate(scenes):
        np.testing.assert_array_equal(scene.start, final.missions.start[index])
        np.testing.assert_array_equal(scene.goal, final.missions.goal[index])


@pytest.mark.slow
def test_many_worlds_have_the_shortest_paths_of_each_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = [room().scene, WITHOUT_A_WAY["wall across"].scene, room().scene]
    alone = runtime.shortest_of(Config(), scenes)
    monkeypatch.setattr(runtime, "MANY", 2)
    assert runtime.shortest_of(Config(), scenes) == alone
    assert alone[1] is None and alone[0] == alone[2] and alone[0] is not None


@pytest.mark.slow
def test_a_learner_compiles_once_and_a_seed_comes_to_the_same_whatever_came_before(clear: Path) -> None:
    _, config = parse_train(["--world", str(clear), *TINY])
    # Blind, since it compiles soonest: it has no camera and no VAE.
    learner = learners.Learner(learners.sensing(config, "DQN blind"))
    first, second, again = (learner.turn(seed) for seed in (0, 1, 0))
    assert first["decisions"] == 512 and len(first["curve"]) == 2
    assert [point["decisions"] for point in first["curve"]] == [256, 512]
    assert first["curve"][0]["seconds"] < first["train_seconds"]
    for one in (first, second, again):
        del one["train_seconds"], one["first_success_seconds"], one["flights"]["planning_seconds"]
        for point in one["curve"]:
            del point["seconds"]
    assert first == again
    assert first != second
    assert len(first["flights"]["outcome"]) == len(first["curve"][0]["test"]) == 1


def test_learners_differ_in_what_they_see_and_in_nothing_else() -> None:
    _, config = parse_train([*MINIATURE, "--env.sensor", "depth"])
    seen = [learners.sensing(config, name) for name in learners.LEARNERS]
    assert [one.env.sensor for one in seen] == ["events", "frames", "blind", "depth", "ranges"]
    same = [dataclasses.replace(one, env=dataclasses.replace(one.env, sensor="depth")) for one in seen]
    assert all(one == config for one in same)


# ------------------------------------------------------------------------------------------- child


def test_a_child_answers_in_turns_and_its_end_is_told_with_its_last_words(tmp_path: Path) -> None:
    script = tmp_path / "echo.py"
    script.write_text(
        "import sys\n"
        "from child import answers\n"
        "stream = answers()\n"
        "print('not an answer')\n"
        "print('{\"ready\": 1}', file=stream)\n"
        "for line in sys.stdin:\n"
        "    print(int(line) * 2, file=stream)\n"
    )
    with Child(runtime.ROOT, script, [], tmp_path / "said.log") as child:
        assert child.answer() == {"ready": 1}
        assert (child.ask("4"), child.ask("5")) == (8, 10)
        with pytest.raises(ChildEndedError, match="^ValueError: invalid literal .* 'x"):
            child.ask("x")
    assert "not an answer" in (tmp_path / "said.log").read_text()


def test_the_memory_of_a_child_is_not_what_its_parent_held_before(tmp_path: Path) -> None:
    held = bytearray(b"1") * 400_000_000  # written, so that it is really there
    script = tmp_path / "light.py"
    script.write_text(
        "import sys\n"
        "from child import answers\n"
        "from resident import peak_of\n"
        "stream = answers()\n"
        "for line in sys.stdin:\n"
        "    own = bytearray(b'1') * int(line)\n"
        "    print(peak_of(), file=stream)\n"
    )
    with Child(runtime.ROOT, script, [], tmp_path / "said.log") as child:
        del held
        # Python itself takes some 10 MB; what the child held and freed is still counted.
        first, second, third = child.ask("0"), child.ask("100000000"), child.ask("0")
    assert first < 100e6
    assert 100e6 < second < 200e6 and third > 100e6


def test_the_memory_of_other_processes_is_counted_while_they_run() -> None:
    assert resident.peak_of_workers() == 0
    worker = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    worker.start()
    try:
        assert 0 < resident.peak_of_workers() <= (resident.peak_of(worker.pid or 0) or 0)
    finally:
        worker.kill()
        worker.join()
    assert resident.peak_of_workers() == 0
