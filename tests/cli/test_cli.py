"""The command line: precedence of flags, exit codes, and sentences for people."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import re
import signal
import subprocess
import sys
import time
import types
from importlib import metadata
from pathlib import Path

import pytest

from edqn_jax.cli import commands, main, train
from edqn_jax.cli.arguments import MEANINGS, flags_of
from edqn_jax.cli.evaluate import EvaluateArgs, parse_evaluate
from edqn_jax.cli.fly import darkening_of, parse_fly, simulate
from edqn_jax.cli.help import COMMON, NAMED, flag_of
from edqn_jax.cli.record import parse_record
from edqn_jax.cli.train import parse_train, train_flags
from edqn_jax.config import Config, get_preset
from edqn_jax.config.limits import limits_of
from edqn_jax.config.loading import make_config
from edqn_jax.config.presets import RANDOM_WORLDS
from edqn_jax.devices import devices
from edqn_jax.errors import CheckError, ConfigError, DivergedError, StoppedError
from edqn_jax.fly.faults import Limits
from edqn_jax.native.shipped import describe_library
from edqn_jax.sim.scene.mjcf import SceneError
from tests.support.processes import PATIENCE_S

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Nothing that a test makes lands in the repository."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def trainer(monkeypatch):
    """Stands in for training: a function to set, and the calls that reached it."""
    stand_in = types.ModuleType("edqn_jax.runs.record")
    calls: list[tuple] = []
    behaviour = types.SimpleNamespace(calls=calls, act=lambda *call: None, callbacks=[], seeds=[])

    def train_run(*call, callback, drawing, seeds, start):
        calls.append(call)
        behaviour.callbacks.append(callback)
        behaviour.seeds.append(seeds)
        return behaviour.act(*call)

    stand_in.__dict__.update(train_run=train_run, Draw=None)  # the gallery names `Draw` as a type
    monkeypatch.setitem(sys.modules, "edqn_jax.runs.record", stand_in)
    monkeypatch.setattr(train, "detect_hardware", lambda: "cpu")
    monkeypatch.setattr(devices, "use_cpu_devices", lambda count=None: None)
    return behaviour


def test_no_argument_trains_in_random_worlds_and_flies_the_papers(trainer):
    _, config = parse_train([])
    assert (config.world.name, config.world.flown) == ("medium", "paper")
    assert config == parse_train(["--world", "medium"])[1] == make_config()


def test_the_world_of_a_file_stands_without_a_flag(tmp_path, trainer):
    file = tmp_path / "options.yaml"
    file.write_text("world: {name: paper}\n")
    assert parse_train(["--config", str(file)])[1] == parse_train(["--world", "paper"])[1] == Config()


def test_help_and_completion_list_the_names_that_a_limit_has():
    limited = {
        f"{group.name}.{option}": limit.names
        for group in dataclasses.fields(Config)
        for option, limits in limits_of(type(getattr(Config(), group.name))).items()
        for limit in limits
        if limit.names
    }
    assert limited and {option: tuple(NAMED.get(option, ())) for option in limited} == limited


@pytest.mark.parametrize("words", [["--events.profile", "dvs"], ["--events.profile=dvs"]])
def test_a_flag_names_a_profile_and_other_flags_change_it(words):
    _, config = parse_train(["--events.shot-rate-hz", "1", "--world", "medium", *words])
    assert config == make_config("medium", events={"profile": "dvs", "shot_rate_hz": 1.0})
    assert config.events.bandwidth_hz == 30.0
    assert parse_train(["--world", "medium", "--events.profile", "ideal"])[1] == make_config("medium")


def test_a_stream_of_all_physics_steps_is_what_seq_prints():
    times = [f"{-0.26 + 0.02 * step:.2f}" for step in range(14)]
    _, config = parse_train(["--events.law", "esim", "--events.stream", "--events.frame-times-s", *times])
    assert config.events.stream and len(config.events.frame_times_s) == 14


def test_flags_win_over_the_file_and_the_file_over_the_preset(tmp_path):
    file = tmp_path / "options.yaml"
    file.write_text("agent: {batch_size: 256, n_step: 3}\n")
    _, config = parse_train(["--preset", "paper", "--config", str(file), "--agent.n-step", "7"])
    assert (config.agent.batch_size, config.agent.n_step) == (256, 7)
    assert config.agent.hidden == get_preset("paper").agent.hidden


@pytest.mark.parametrize(
    "argv",
    [
        ["--num-envs", "64", "--total-steps", "4096", "--seed", "5", "--world", "dense"],
        ["--num_envs=64", "--total_steps=4096", "--seed=5", "--world=dense"],
        [
            "--train.num-envs",
            "64",
            "--train.total-steps",
            "4096",
            "--train.seed",
            "5",
            "--world.name",
            "dense",
        ],
    ],
)
def test_short_and_long_names_say_the_same(argv):
    _, config = parse_train(argv)
    train = config.train
    assert (train.num_envs, train.total_steps, train.seed, config.world.name) == (64, 4096, 5, "dense")


@pytest.mark.parametrize("flag", ["--world", "--world.name"])
def test_a_random_world_brings_its_budget_and_a_flag_overrides_it(flag):
    assert parse_train([flag, "medium"])[1].train.total_steps == RANDOM_WORLDS["train"]["total_steps"]
    assert parse_train([flag, "medium", "--total-steps", "2048"])[1].train.total_steps == 2048


def test_a_world_from_a_file_is_found_again_from_any_folder(tmp_path):
    (tmp_path / "mine.xml").touch()
    assert parse_train(["--world", "mine.xml"])[1].world.name == str(tmp_path / "mine.xml")


def test_a_random_world_is_not_a_file_of_its_name(tmp_path):
    (tmp_path / "medium").touch()
    assert parse_train(["--world", "medium"])[1].world.name == "medium"


def test_every_kind_of_option_can_be_a_flag():
    argv = [
        "--agent.hidden",
        "32",
        "16",
        "--agent.no-double",
        "--events.frame-times-s",
        "-0.04",
        "-0.02",
        "0",
    ]
    _, config = parse_train([*argv, "--events.law", "esim", "--agent.max-gradient-norm", "inf"])
    assert (config.agent.hidden, config.agent.double, config.events.law) == ((32, 16), False, "esim")
    assert config.events.frame_times_s == (-0.04, -0.02, 0.0)
    assert config.agent.max_gradient_norm == float("inf")


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["train", "--num-envs", "0"], "train.num_envs must be at least 1, not 0"),
        (["train", "--agent.replay-size", "64"], "agent.replay_size must be at least agent.batch_size"),
        (["train", "--env.actions", "velocity"], "env.actions must be moves for training, not velocity"),
        (
            ["train", "--env.actions", "move"],
            "there is no set of actions 'move'; did you mean 'moves', or one that --import registers?",
        ),
        (["train", "--agent.bach-size", "64"], "--agent.batch-size"),
        (["train", "--train.num-envs", "many"], "--train.num-envs must be a whole number, not 'many'"),
        (["train", "--events.threshold", "x"], "--events.threshold must be a number, not 'x'"),
        (["train", "--agent.hidden", "a", "b"], "--agent.hidden must be whole numbers, not 'a b'"),
        (["train", "--seeds", "many"], "--seeds must be a whole number, not 'many'"),
        (["train", "--agent.double", "yes"], "'yes' is a word too many; 'edqn train --help' lists what there is"),
        (["evaluate", "pretrained", "--start", "1", "2"], "--start must be X Y Z, not '1 2'"),
        (["evaluate", "pretrained", "--start", "1]", "2", "3"], "--start must be X Y Z, not '1] 2 3'"),
        (["evaluate", "pretrained", "--missions", "a'b"], """--missions must be a whole number, not 'a'b'"""),
        (["evaluate", "pretrained", "--missions"], "--missions must be followed by a value"),
        (["record"], "'edqn record' needs POLICY and FILE; see 'edqn record --help'"),
        (["completion", "csh"], "shell cannot be 'csh'"),
        (["train", "--seeds", "0"], "--seeds must be at least 1, not 0"),
        (["train", "--preset", "best"], "--preset cannot be 'best'; known are default, paper"),
        (["train", "--events.law", "esmi"], "--events.law cannot be 'esmi'; did you mean 'esim'?"),
        (["train", "--config", "nowhere.yaml"], "nowhere.yaml"),
        (["train", "--resume", "must"], "--resume must needs --run-dir"),
        (["evaluate"], "'edqn evaluate' needs POLICY; see"),
        (["evaluate", "nowhere"], "there is no run in 'nowhere'"),
        (["quux"], "there is no command 'quux'; known are train, evaluate"),
        (["trian"], "did you mean 'train'?"),
        (["train", "--nun-envs", "64"], "there is no option '--nun-envs'; did you mean '--num-envs'?"),
        (["evaluate", "runs", "--misions=3"], "there is no option '--misions'; did you mean '--missions'?"),
        (["evaluate", "runs", "--gusts-m-s", "5"], "there is no option '--gusts-m-s'; did you mean '--air.gusts-m-s'?"),
        (["evaluate", "runs", "--conditions", "5"], "there is no option '--conditions'; 'edqn evaluate --help-all'"),
        (["evaluate", "runs", "--env.speed-m-s", "5"], "there is no option '--env.speed-m-s'"),
        (["train", "--zzz"], "there is no option '--zzz'; 'edqn train --help-all' lists what there is"),
    ],
)
def test_bad_input_ends_with_2_a_sentence_and_nothing_made(argv, says, capsys, tmp_path, trainer):
    assert main(argv) == 2
    said = capsys.readouterr()
    assert said.err.startswith("edqn: ") and says in said.err and said.err.count("\n") == 1 and not said.out
    assert list(tmp_path.iterdir()) == []
    assert trainer.calls == []


def test_a_recording_that_cannot_be_written_is_refused_before_a_policy_is_loaded(tmp_path):
    with pytest.raises(ConfigError, match=r"flight.gif' cannot be written: there is no folder"):
        parse_record(["pretrained", str(tmp_path / "nowhere" / "flight.gif")])


def test_our_own_complaints_are_one_line(capsys):
    main(["train", "--num-envs", "12"])
    assert capsys.readouterr().err == (
        "edqn: train.num_envs must be a multiple of train.shards (8), such as 16, not 12\n"
    )


def test_missions_must_be_at_least_one(capsys, tmp_path):
    (tmp_path / "config.yaml").touch()
    assert main(["evaluate", str(tmp_path), "--missions", "0"]) == 2
    assert "--missions must be at least 1" in capsys.readouterr().err


def test_training_gets_the_configuration_and_a_folder_that_is_not_made_yet(trainer, tmp_path):
    assert main(["train", "--seed", "3", "--run-dir", "here"]) == 0
    config, run = trainer.calls[0][:2]
    assert config.train.seed == 3
    assert run.path == Path("here") and not run.path.exists()


def test_several_seeds_are_trained_together(trainer):
    assert main(["train", "--seeds", "4", "--seed", "3", "--run-dir", "here"]) == 0
    config, run = trainer.calls[0][:2]
    assert (config.train.seed, trainer.seeds, run.path) == (3, [4], Path("here"))


@pytest.mark.parametrize(
    ("argv", "envs"),
    [
        (["--world", "medium"], 16_384),
        (["--world", "medium", "--tuned-for", "cpu"], 256),
        (["--world", "medium", "--num-envs", "64"], 64),
        (["--world", "paper"], 2048),
        (["--world", "medium", "--preset", "paper"], 16),
    ],
)
def test_worlds_are_tuned_for_a_gpu_where_there_is_one(argv, envs, monkeypatch):
    monkeypatch.setattr(train, "detect_hardware", lambda: "gpu")
    assert parse_train(argv)[1].train.num_envs == envs


def test_what_was_chosen_for_a_gpu_is_printed(trainer, monkeypatch, capsys):
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")
    assert main(["train", "--tuned-for", "gpu", "--world", "medium", "--run-dir", "here"]) == 0
    assert "Tuned for a GPU: 16,384 environments, 8 updates of 4,096 a step" in capsys.readouterr().out
    assert main(["train", "--tuned-for", "gpu", "--world", "paper", "--run-dir", "there"]) == 0
    assert "Tuned for a GPU: 2,048 environments, 8 updates of 1,024 a step" in capsys.readouterr().out
    assert main(["train", "--tuned-for", "gpu", "--preset", "paper", "--run-dir", "again"]) == 0
    assert "Tuned" not in capsys.readouterr().out  # it is the paper's


def test_a_gpu_that_jax_cannot_use_is_one_sentence(trainer, capsys):
    assert main(["train", "--tuned-for", "gpu", "--world", "medium", "--run-dir", "here"]) == 2
    assert "JAX can use none here" in capsys.readouterr().err and not trainer.calls


@pytest.mark.parametrize(
    ("ending", "code"),
    [
        (ConfigError("a replay that is too small"), 2),
        (SceneError("a start inside a wall"), 2),
        (DivergedError("the Q loss is not finite"), 3),
        (CheckError("--debug: an index is out of bounds"), 1),
        (StoppedError("stopped after saving"), 143),
    ],
)
def test_each_ending_of_training_has_its_exit_code(ending, code, trainer, capsys):
    def act(*call):
        raise ending

    trainer.act = act
    assert main(["train", "--run-dir", "here"]) == code
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_reaches_training_as_a_wish_to_stop(number, code, trainer, capsys):
    def act(config, run, progress, stop):
        assert not stop.is_requested()
        with stop.obey_signals():
            os.kill(os.getpid(), number)
            while not stop.is_requested():
                time.sleep(0.01)
        raise StoppedError("stopped after saving")

    trainer.act = act
    before = signal.getsignal(number)
    assert main(["train", "--run-dir", "here"]) == code
    assert signal.getsignal(number) is before
    said, until = "", time.monotonic() + 10.0
    while "stopping after this chunk; a second signal ends at once" not in said:  # a thread says it
        assert time.monotonic() < until
        said += capsys.readouterr().out
        time.sleep(0.01)


def test_evaluate_hands_on_what_was_asked_for(monkeypatch, tmp_path):
    (tmp_path / "config.yaml").touch()
    asked: list[EvaluateArgs] = []
    monkeypatch.setitem(commands.RUN_COMMANDS, "evaluate", (parse_evaluate, asked.append))
    monkeypatch.setattr(devices, "use_cpu_devices", lambda count=None: None)
    argv = [str(tmp_path), "--world", "dense", "--start", "1", "2", "3", "--goal", "-4", "5.5", "6"]
    assert main(["evaluate", *argv, "--missions", "9", "--seed", "2", "--json", "a.json"]) == 0
    whole = EvaluateArgs(tmp_path, "dense", (1.0, 2.0, 3.0), (-4.0, 5.5, 6.0), missions=9, seed=2, json=Path("a.json"))
    assert main(["evaluate", str(tmp_path), "--shuffle-codes", "--trajectories", "a.npz"]) == 0
    assert asked == [whole, EvaluateArgs(tmp_path, shuffle_codes=True, trajectories=Path("a.npz"))]
    assert all(not each.conditions for each in asked)


def test_evaluate_hands_on_the_disturbances_that_were_given_and_no_others(tmp_path):
    (tmp_path / "config.yaml").touch()
    words = ["--air.gusts-m-s", "5", "--air.no-drag", "--env.action_delay=1", "--body.mass-share", "0"]
    given = parse_evaluate([str(tmp_path), *words]).conditions
    assert given == {"air": {"gusts_m_s": 5.0, "drag": False}, "env": {"action_delay": 1}, "body": {"mass_share": 0.0}}
    assert shown("evaluate", "--help-all").count("--air.gusts-m-s FLOAT") == 1


def shown(*words: str) -> str:
    """What a command prints that exits with 0."""
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        patch.setenv("COLUMNS", "100")
        assert main(words) == 0
    return said.getvalue()


WITHOUT_JAX = (
    ("train", "--world", "medium", "--help-all"),
    ("evaluate", "--help"),
    ("evaluate", "--help-all"),
    ("train", "--world", "paper", "-h"),
    ("--version",),
    ("completion", "bash"),
)


def test_help_versions_and_completion_do_not_start_jax():
    script = (
        f"import sys; from edqn_jax.cli import main\nfor words in {WITHOUT_JAX!r}: assert main(words) == 0, words\n"
    )
    script += "assert 'jax' not in sys.modules"
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.whole
def test_a_simulated_flights_world_is_looked_at_before_its_packages(monkeypatch):
    monkeypatch.setitem(sys.modules, "edqn_jax.fly.simulated.missions", None)  # as where its extra is not installed
    args = parse_fly(["pretrained-looks", "--simulate", "rums"])
    with pytest.raises(ConfigError, match="rums"):
        simulate(args)
    with pytest.raises(ImportError):
        simulate(dataclasses.replace(args, simulate="rooms"))


def test_a_camera_of_a_smaller_contrast_sees_more_events_as_its_lens_is_covered():
    assert (
        darkening_of(0.2, 7.0) == Limits.darkening and darkening_of(0.1, 7.0) == 4.0 and darkening_of(None, 7.0) == 7.0
    )


def test_help_all_lists_every_option():
    said = shown("train", "--world", "medium", "--help-all")
    assert all(flag in said for flag in train_flags() - {"--help-all"})
    assert "--agent.batch-size INT" in said and "Replayed samples per update." in said
    assert f"(default: {RANDOM_WORLDS['train']['total_steps']})" in said
    assert "--num-envs INT, --train.num-envs INT" in said


def test_help_of_evaluate_leaves_what_disturbs_flights_to_help_all():
    short, whole = shown("evaluate", "--help"), shown("evaluate", "--help-all")
    assert len(short.splitlines()) < 60 and "--missions N" in short and "--air.gusts-m-s FLOAT" not in short
    assert "`edqn evaluate --help-all`" in short and "--missions N" in whole and "--air.gusts-m-s FLOAT" in whole


@pytest.mark.parametrize("flag", ["--help", "-h"])
def test_help_fits_a_screen_and_has_the_defaults_of_the_world(flag):
    said = shown("train", "--world", "paper", flag)
    assert len(said.splitlines()) < 50
    assert "--camera.width N         pixels across (default: 32)" in said
    assert f"(default: {Config().train.total_steps})" in said and "decisions in all, of 0.26 s each" in said
    assert "`edqn train --help-all` shows all" in said and "--camera.samples-down" not in said


@pytest.mark.parametrize(
    ("words", "does"),
    [
        (["--help"], "Train drones to fly"),
        (["train", "--help"], "Train a drone"),
        (["evaluate", "--help"], "Fly a policy"),
        (["check", "--help"], "Say whether a policy can fly"),
        (["record", "--help"], "Fly a policy"),
        (["report", "--help"], "Write one HTML file"),
        (["verify", "--help"], "Verify a finished run"),
        (["export", "--help"], "Write a policy as ONNX"),
        (["events", "--help"], "Say what a file of events holds"),
        (["fly", "--help"], "Fly an exported policy over MAVLink"),
        (["completion", "--help"], "Print a script"),
    ],
)
def test_a_help_begins_with_what_the_command_does_and_has_an_example(words, does, capsys):
    assert main(words) == 0
    usage, text, *_, rest = capsys.readouterr().out.split("\n\n", 2)
    assert usage.startswith("usage: edqn") and text.startswith(does)
    examples = re.search(r"Examples?:\n((?:  .*\n)+)", rest)
    assert examples and " ".join(["edqn", *words[:-1]]) in examples[1]


@pytest.mark.parametrize("name", COMMON)
def test_what_the_short_help_shows_is_an_option(name):
    assert flag_of(name) in train_flags()


@pytest.mark.parametrize(
    ("flag", "meant"),
    [
        ("--num", "--num-envs"),
        ("--batch-size", "--agent.batch-size"),
        ("--sensr", "--env.sensor"),
        ("--camera.widht", "--camera.width"),
        ("--total_step", "--total-steps"),
        ("--lr", "--agent.learning-rate"),
        ("--agent.lr", "--agent.learning-rate"),
        ("--agent.gamma", "--agent.discount"),
        ("--gamma", "--agent.discount"),
        ("--envs", "--num-envs"),
        ("--train.envs", "--train.num-envs"),
        ("--steps", "--total-steps"),
        ("--batch", "--agent.batch-size"),
        ("--encoder.batch", "--encoder.batch-size"),
        ("--encoder.lr", "--encoder.learning-rate"),
        ("--qx", None),
    ],
)
def test_a_flag_that_is_short_or_wrong_leads_to_the_one_that_was_meant(flag, meant):
    says = f"did you mean '{meant}'" if meant else "'edqn train --help-all' lists what there is"
    with pytest.raises(ConfigError, match=re.escape(says)):
        parse_train([flag, "3"])


@pytest.mark.parametrize("meant", sorted(set(MEANINGS.values())))
def test_what_people_mean_is_an_option(meant):
    assert any(re.fullmatch(rf"--(\w+\.)?{meant}", flag) for flag in train_flags() | flags_of(EvaluateArgs))


def test_the_versions_are_those_of_the_packages():
    versions = [f"{name} {metadata.version(name)}" for name in ("edqn-jax", "jax", "mujoco", "mujoco-mjx")]
    assert shown("--version").splitlines() == [*versions, f"library in C: {describe_library()}"]


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["ev"], ["evaluate", "events"]),
        (["rep"], ["report"]),
        (["train", "--num-e"], ["--num-envs"]),
        (["train", "--world", "me"], ["medium"]),
        (["train", "--env.sensor", "fr"], ["frames", "frame-pair"]),
        (["train", "--world", "mine"], []),  # bash then offers files
        (["evaluate", "runs/", "--world", "me"], ["medium"]),
        (["evaluate", "runs/", "--air.gusts"], ["--air.gusts-m-s"]),
        (["record", "runs/", "--go"], ["--goal"]),
        (["check", "mine.xml", "--pol"], ["--policy"]),
    ],
)
def test_bash_completes_commands_options_and_values(words, offered, completion):
    line = " ".join(["edqn", *words])
    script = f"""
        source {completion}
        COMP_WORDS=({line}); COMP_CWORD={len(words)}
        complete -p edqn | grep --quiet -- '-o default' || exit 1
        $(complete -p edqn | sed 's/.*-F \\([^ ]*\\).*/\\1/')
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == offered and not done.stderr


@pytest.fixture(scope="module")
def completion(tmp_path_factory):
    """The script for bash, in a file."""
    file = tmp_path_factory.mktemp("completion") / "edqn.bash"
    file.write_text(shown("completion", "bash"))
    return file


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_have_their_scripts(shell, capsys):
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "--num-envs" in script and {"zsh": "_files; return", "fish": "complete --command"}[shell] in script


def test_the_module_is_the_command():
    shown = subprocess.run(
        [sys.executable, "-m", "edqn_jax", "trian"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert shown.returncode == 2 and "did you mean 'train'?" in shown.stderr


@pytest.mark.slow
def test_train_py_is_the_train_command():
    shown = subprocess.run(
        [sys.executable, str(ROOT / "train.py"), "--num-envs", "0"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert shown.returncode == 2
    *phases, said = shown.stderr.splitlines()
    assert phases and all(line.startswith(("edqn train: starting", "  starting")) for line in phases)
    assert said == "edqn: train.num_envs must be at least 1, not 0"


def test_a_reader_that_has_enough_is_no_error() -> None:
    reads, writes = os.pipe()
    os.close(reads)
    words = [sys.executable, "-m", "edqn_jax", "train", "--help"]
    with os.fdopen(writes, "wb") as closed:
        ended = subprocess.run(words, cwd=ROOT, stdout=closed, stderr=subprocess.PIPE, text=True, timeout=PATIENCE_S)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_sinks_are_made_only_where_they_are_asked_for(trainer, tmp_path, monkeypatch):
    monkeypatch.setattr(train.importlib.util, "find_spec", lambda name, *rest: name)
    run = str(tmp_path / "run")
    assert main(["train", "--run-dir", run]) == 0
    assert main(["train", "--run-dir", run, "--track", "tensorboard", "wandb", "--view", "rerun"]) == 0
    nothing, sinks = trainer.callbacks
    assert nothing is None and list(sinks._makers) == ["tensorboard", "wandb", "rerun"]
