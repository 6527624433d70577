"""Loading, merging and checking the configuration."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

from edqn_jax.config import FAMILIES, PRESETS, Config, EventsConfig, get_preset
from edqn_jax.config.limits import limits_of
from edqn_jax.config.loading import apply_layer, load_layer, make_config, resolve_config, to_yaml
from edqn_jax.config.presets import RANDOM_WORLDS
from edqn_jax.config.profiles import PROFILES
from edqn_jax.config.rules import validate
from edqn_jax.errors import ConfigError


def write(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "options.yaml"
    file.write_text(text)
    return file


def changed(group: str, **options: Any) -> Config:
    config = Config()
    return dataclasses.replace(config, **{group: dataclasses.replace(getattr(config, group), **options)})


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_valid(name):
    validate(get_preset(name))


@pytest.mark.parametrize("name", PRESETS)
def test_a_written_configuration_reads_back_the_same(name, tmp_path):
    config = get_preset(name)
    assert apply_layer(Config(), load_layer(write(tmp_path, to_yaml(config))), "file") == config


def test_the_file_wins_over_the_preset_and_leaves_the_rest(tmp_path):
    config = resolve_config("paper", write(tmp_path, "agent: {batch_size: 256}\n"))
    assert config == dataclasses.replace(
        get_preset("paper"), agent=dataclasses.replace(get_preset("paper").agent, batch_size=256)
    )


def test_an_empty_file_changes_nothing(tmp_path):
    assert resolve_config(file=write(tmp_path, "# nothing\n")) == resolve_config()


@pytest.mark.parametrize("world", FAMILIES)
def test_a_random_world_brings_its_own_budget(world):
    assert resolve_config(world=world).train.total_steps == RANDOM_WORLDS["train"]["total_steps"]


def test_a_gpu_brings_its_own_sizes_and_files_and_the_papers_preset_keep_theirs(tmp_path):
    medium = resolve_config(world="medium", tuned_for="gpu")
    validate(medium)
    assert medium.train.num_envs == 16_384
    assert medium.events.threshold == RANDOM_WORLDS["events"]["threshold"]  # of random worlds on any hardware
    assert medium.world.name == "medium" and medium.world.pool_size > Config().world.pool_size
    own = resolve_config(world="paper", tuned_for="gpu")
    assert (own.train.num_envs, own.agent.batch_size, own.events) == (2048, 1024, Config().events)
    file = write(tmp_path, "train: {num_envs: 64}\n")
    assert resolve_config(file=file, world="medium", tuned_for="gpu").train.num_envs == 64
    assert resolve_config("paper", tuned_for="gpu") == get_preset("paper")
    with pytest.raises(ConfigError, match="must be 'cpu' or 'gpu', not 'tpu'"):
        make_config("medium", tuned_for="tpu")  # type: ignore[arg-type]


def test_random_worlds_have_their_own_warm_up_and_the_papers_preset_its_own_agent():
    medium, paper = resolve_config(world="medium"), get_preset("paper")
    assert (medium.agent.learning_rate, paper.agent.learning_rate, paper.agent.history) == (1e-3, 4e-4, 1)
    assert (medium.encoder.warmup_decisions, medium.encoder.retrain_at) == (65_536, (0.15,))
    assert (paper.encoder.warmup_updates_per_step, paper.encoder.retrain_at) == (12, ())
    assert (paper.encoder.architecture, paper.encoder.target) == ("pooled", "sensed")


@pytest.mark.parametrize("hardware", ["cpu", "gpu"])
def test_worlds_with_walls_are_learnt_along_their_ways_and_open_ones_are_not(hardware):
    rooms, mixed, medium = (resolve_config(world=name, tuned_for=hardware) for name in ("rooms", "mixed", "medium"))
    larger = {"hidden", "layer_norm", "replay_size"} if hardware == "gpu" else set()
    kept = {name: value for name, value in dataclasses.asdict(rooms.agent).items() if name not in larger}
    assert rooms.env == mixed.env and kept.items() <= dataclasses.asdict(mixed.agent).items()
    assert (rooms.env.reward, medium.env.reward) == ("geodesic", "progress")
    assert rooms.env.collision_reward == medium.env.collision_reward
    assert rooms.train == medium.train and rooms.encoder == medium.encoder
    narrow = resolve_config(world="narrow", tuned_for=hardware)
    assert dataclasses.replace(narrow, world=mixed.world) == mixed and narrow.world.name == "narrow"


def test_a_world_that_somebody_drew_is_learnt_along_its_ways_and_the_papers_map_is_not(tmp_path):
    drawn, paper = resolve_config(world="house.xml"), resolve_config(world="paper")
    assert paper == dataclasses.replace(Config(), world=dataclasses.replace(Config().world, name="paper"))
    assert (drawn.env.reward, drawn.env.collision_reward) == ("geodesic", -60.0)
    assert drawn.train.total_steps > paper.train.total_steps and drawn.agent == paper.agent
    assert resolve_config(world="house.xml", tuned_for="gpu").env.reward == "geodesic"
    file = write(tmp_path, "env: {reward: progress}\n")
    assert resolve_config(file=file, world="house.xml").env.reward == "progress"
    assert resolve_config("paper", world="house.xml").env.reward == "sparse"


def test_a_profile_is_its_figures_and_what_is_given_beside_it_wins(tmp_path):
    base = make_config("medium").events
    noisy = make_config("medium", events={"profile": "dvs"}).events
    # The figures of v2e's noisy setting: 0.2 +- 0.05, 30 Hz, 0.1 Hz, 5 Hz, 10 ms.
    assert (noisy.threshold, noisy.tolerance, noisy.contrast_on, noisy.contrast_off) == (0.2,) * 4
    assert noisy.threshold_mismatch * noisy.threshold == pytest.approx(0.05)
    assert (noisy.bandwidth_hz, noisy.leak_rate_hz, noisy.shot_rate_hz, noisy.refractory_ns) == (30, 0.1, 5.0, 1e7)
    assert (noisy.law, noisy.frame_times_s) == (base.law, base.frame_times_s)
    sensitive = make_config("medium", events={"threshold": 0.05, "profile": "dvs", "shot_rate_hz": 0.0}).events
    assert (sensitive.threshold, sensitive.tolerance, sensitive.shot_rate_hz) == (0.05, 0.2, 0.0)
    file = write(tmp_path, "events: {profile: dark, leak_rate_hz: 1.0}\n")
    dark = resolve_config(file=file, world="medium").events
    assert (dark.threshold, dark.bandwidth_hz, dark.leak_rate_hz) == (0.2, 3.0, 1.0)
    config = make_config("medium", file=file)
    assert apply_layer(Config(), load_layer(write(tmp_path, to_yaml(config))), "file") == config
    ideal = make_config("medium", file=file, events={"profile": "ideal"}).events
    assert (ideal.bandwidth_hz, ideal.leak_rate_hz, ideal.threshold) == (0.0, 0.0, 0.2)
    assert make_config("medium", events={"profile": "ideal"}).events == base


@pytest.mark.parametrize("name", PROFILES)
def test_every_profile_names_the_same_faults_and_is_valid(name):
    validate(make_config("medium", events={"profile": name}))
    assert set(PROFILES["ideal"]) <= set(PROFILES[name])
    assert get_args(get_type_hints(EventsConfig)["profile"]) == tuple(PROFILES)


def test_a_random_world_in_the_file_brings_its_budget_too(tmp_path):
    assert (
        resolve_config(file=write(tmp_path, "world: {name: dense}\n")).train.total_steps
        == RANDOM_WORLDS["train"]["total_steps"]
    )


def test_a_budget_in_the_file_wins_over_the_random_world(tmp_path):
    file = write(tmp_path, "train: {total_steps: 1024}\n")
    config = resolve_config(file=file, world="medium")
    assert (config.world.name, config.train.total_steps) == ("medium", 1024)


def test_the_papers_preset_keeps_its_budget_on_random_worlds():
    assert resolve_config("paper", world="medium").train.total_steps == 500_000


def test_numbers_in_scientific_notation_and_infinity_are_numbers(tmp_path):
    agent = resolve_config(file=write(tmp_path, "agent: {learning_rate: 1e-3, max_gradient_norm: .inf}\n")).agent
    assert (agent.learning_rate, agent.max_gradient_norm) == (1e-3, float("inf"))


def test_a_whole_number_may_stand_for_a_float():
    discount = apply_layer(Config(), {"agent": {"discount": 1}}, "file").agent.discount
    assert isinstance(discount, float) and discount == 1.0


@pytest.mark.parametrize(
    ("name", "off", "on"),
    [("encoder.pooling", "sum", "max"), ("encoder.sequence_decisions", 1, 4), ("agent.munchausen", 0.0, 0.9)],
)
def test_an_option_that_is_no_longer_there_may_be_off_but_not_on(name, off, on):
    group, option = name.split(".")
    assert apply_layer(Config(), {group: {option: off}}, "config.yaml") == Config()
    with pytest.raises(
        ConfigError, match=rf"config.yaml: '{name}' is no longer an option, and .*{on}.* commit e3f1c6b"
    ):
        apply_layer(Config(), {group: {option: on}}, "config.yaml")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("agent: {bach_size: 3}", "there is no key 'agent.bach_size'; did you mean 'batch_size'?"),
        ("agnet: {batch_size: 3}", "there is no group 'agnet'; did you mean 'agent'?"),
        ("batch_size: 3", "there is no group 'batch_size'; it belongs under 'encoder:' or 'agent:'"),
        ("zzz: {a: 1}", "known are world, drone, camera"),
        ("agent: 3", "'agent' must hold keys such as"),
        ("agent: {batch_size: big}", "'agent.batch_size' must be a whole number, not the text 'big'"),
        ("agent: {batch_size: 2.5}", "'agent.batch_size' must be a whole number, not 2.5"),
        ("agent: {batch_size: true}", "'agent.batch_size' must be a whole number, not true"),
        ("agent: {discount: high}", "'agent.discount' must be a number, not the text 'high'"),
        ("agent: {double: 1}", "'agent.double' must be true or false, not 1"),
        ("agent: {hidden: 16}", "'agent.hidden' must be a list of whole numbers, not 16"),
        (
            "agent: {hidden: [16, x]}",
            "each of options.yaml: 'agent.hidden' must be a whole number, not the text 'x'",
        ),
        ("camera: {sky_rgb: [1, 1]}", "'camera.sky_rgb' must be a list of 3 numbers, not a list of 2"),
        ("events: {law: esmi}", "'events.law' must be one of paper, airsim, esim, not the text 'esmi'"),
        ("world: {name: }", "'world.name' must be text, not nothing"),
        ("agent: {learning_rate: 1" + 400 * "0" + "}", "'agent.learning_rate' must be a number, not a huge number"),
        ("agent: {n_step: 1" + 5000 * "0" + "}", "is not valid YAML: Exceeds the limit"),
        ("train: {num_envs: " + 5000 * "[" + 5000 * "]" + "}", "is nested too deeply for a file of options"),
        ("train: !!python/object/apply:os.system [ls]", "is not valid YAML at line 1: could not determine"),
        ("- 1", "must hold groups of keys such as 'agent:'"),
        ("agent: {n_step: 1, n_step: 2}", "is not valid YAML at line 1: the key 'n_step' is given twice"),
        ("? [n_step, double]\n: 1", "is not valid YAML at line 1: a key must be a word"),
        ("agent:\n  {n_step: 1}: 1", "is not valid YAML at line 2: a key must be a word"),
        ("agent: {", "is not valid YAML at line"),
    ],
)
def test_a_mistake_in_the_file_is_named_with_what_would_be_right(text, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("options.yaml").write_text(text)
    with pytest.raises(ConfigError) as error:
        resolve_config(file=Path("options.yaml"))
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match="cannot read the configuration file .*nowhere.yaml"):
        resolve_config(file=tmp_path / "nowhere.yaml")


def test_a_file_without_end_is_not_read_to_its_end():
    with pytest.raises(ConfigError, match="'/dev/zero' has more than 1,000,000 bytes, so it is no file of options"):
        resolve_config("default", Path("/dev/zero"))


def test_a_file_that_is_not_text_is_named(tmp_path):
    file = tmp_path / "picture.yaml"
    file.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(ConfigError, match="picture.yaml"):
        resolve_config(file=file)


def numeric_options() -> list[tuple[str, str, object]]:
    nonsense = {int: -(10**9), float: float("nan")}
    return [
        (group.name, option.name, nonsense[type(value)])
        for group in dataclasses.fields(Config)
        for option in dataclasses.fields(getattr(Config(), group.name))
        if type(value := getattr(getattr(Config(), group.name), option.name)) in nonsense
    ]


@pytest.mark.parametrize("group", [group.name for group in dataclasses.fields(Config)])
def test_every_option_that_is_a_number_or_a_list_says_its_limits_in_its_type(group):
    section = getattr(Config(), group)
    numbers = {name for name, value in vars(section).items() if type(value) in (int, float, tuple)}
    limited = {name: limits for name, limits in limits_of(type(section)).items() if limits}
    assert numbers == {name for name, limits in limited.items() if not any(limit.names for limit in limits)}


@pytest.mark.parametrize(("group", "option", "nonsense"), numeric_options())
def test_no_numeric_option_can_be_nonsense(group, option, nonsense):
    with pytest.raises(ConfigError, match=f"{group}.{option} must be"):
        validate(changed(group, **{option: nonsense}))


@pytest.mark.parametrize(
    ("group", "options", "says"),
    [
        ("train", {"num_envs": 0}, "train.num_envs must be at least 1, not 0"),
        ("train", {"num_envs": 10**9}, "train.num_envs must be at most 1000000, not 1000000000"),
        ("train", {"num_envs": 10**400}, "train.num_envs must be at most 1000000, not a huge number"),
        ("train", {"validation_missions": 10**9}, "train.validation_missions must be at most 100000"),
        ("world", {"missions": 10**9}, "world.missions must be at most 1000000"),
        ("camera", {"width": 100_000}, "camera.width must be at most 1024, not 100000"),
        ("train", {"num_envs": 12}, r"must be a multiple of train.shards \(8\), such as 16, not 12"),
        ("train", {"devices": 3}, "train.devices must be 0 or a divisor of train.shards"),
        (
            "agent",
            {"replay_size": 512, "batch_size": 1024},
            r"agent.replay_size must be at least agent.batch_size \(1024\), not 512",
        ),
        (
            "agent",
            {"replay_size": 1024, "learning_starts": 0},
            "observations for each of the 256 environments",
        ),
        ("agent", {"learning_starts": 10**9}, "agent.learning_starts must be at most agent.replay_size"),
        ("agent", {"batch_size": 100}, "agent.batch_size must be a multiple of train.shards"),
        ("agent", {"hidden": ()}, "agent.hidden must be one or more widths"),
        (
            "agent",
            {"exploration_end": 0.5, "exploration_start": 0.1},
            "must be at most agent.exploration_start",
        ),
        ("events", {"frame_times_s": (0.0,)}, "at least two times"),
        ("encoder", {"retrain_at": (0.5, 0.2)}, r"encoder.retrain_at must be shares .* in rising order, not 0.5, 0.2"),
        ("encoder", {"retrain_at": (1.0,)}, "encoder.retrain_at must be shares between 0 and 1"),
        ("encoder", {"retrain_at": (0.5,), "warmup_decisions": 0}, "warmup_decisions must be at least 1 where"),
        ("encoder", {"batch_size": 12}, r"encoder.batch_size must be a multiple of train.shards \(8\), such as 16"),
        (
            "env",
            {"reward": "potential", "potential_discount": 0.9},
            "must be 0.97, agent.discount, with env.reward potential",
        ),
        ("env", {"heading": "flight"}, "env.position must be false with env.heading flight, not True"),
        ("agent", {"turn": True}, r"agent.turn needs a random world \(sparse, .*\), not 'paper': give --agent.no-turn"),
        (
            "world",
            {"flown": "my.xml"},
            r"world.flown is for random worlds \(.*or one that --import registers\) alone, 'paper' is flown itself",
        ),
        (
            "world",
            {"name": "sparse", "flown": "dense"},
            "must be `paper` or an MJCF file, not the random world 'dense'",
        ),
        ("encoder", {"patch_layers": ()}, "encoder.patch_layers must be one or more widths"),
        ("encoder", {"joint_layers": (8, 0)}, "encoder.joint_layers must be one or more widths"),
        ("events", {"frame_times_s": (-0.04, -0.02)}, "end at 0"),
        ("events", {"frame_times_s": (-0.02, -0.04, 0.0)}, "rising order"),
        (
            "events",
            {"frame_times_s": (-0.03, 0.0)},
            r"multiples of drone.physics_dt_s \(0.02 s\), not -0.03, 0",
        ),
        ("events", {"frame_times_s": (-0.28, 0.0)}, "within the decision's 0.26 s"),
        (
            "events",
            {"stream": True},
            "must be times that begin at -0.26, with the decision, where events.stream",
        ),
        ("camera", {"sky_rgb": (0.5, 0.5, 1.5)}, "camera.sky_rgb must be three shares"),
        ("light", {"most_lux": 100.0}, "light.least_lux must be between 0.1 and 10000, not 0.0"),
        ("light", {"least_lux": 1.0, "most_lux": 20_000.0}, "light.most_lux must be between 0.1 and 10000, not 20000"),
        ("light", {"least_lux": 9.0, "most_lux": 1.0}, r"light.least_lux must be at most light.most_lux \(1\), not 9"),
        ("events", {"most_contrast": 0.2}, "events.least_contrast must be between 0.01 and 1, not 0.0"),
        ("events", {"least_contrast": 0.1, "most_contrast": 2.0}, "most_contrast must be between 0.01 and 1, not 2.0"),
        (
            "events",
            {"least_contrast": 0.3, "most_contrast": 0.1},
            r"events.least_contrast must be at most events.most_contrast \(0.1\), not 0.3",
        ),
        ("events", {"faults_share": 1.5}, "events.faults_share must be between 0 and 1"),
        ("events", {"sensor_pixels": 4, "law": "airsim"}, "events.sensor_pixels must be 1 with events.law airsim"),
    ],
)
def test_what_cannot_be_run_is_named_with_its_limits(group, options, says):
    with pytest.raises(ConfigError, match=says):
        validate(changed(group, **options))


def test_the_flight_through_another_world_leaves_a_test_world_to_judge_by():
    make_config("medium", train={"validation_missions": 2})
    make_config("medium", world={"flown": ""}, train={"validation_missions": 1})
    with pytest.raises(ConfigError, match="validation_missions must be at least 2 with world.flown, .*, not 1"):
        make_config("medium", train={"validation_missions": 1})


def test_frames_may_fill_the_whole_decision():
    steps = tuple(round(-0.02 * step, 2) for step in range(13, -1, -1))
    validate(changed("events", frame_times_s=steps))


def test_options_of_the_world_are_a_group_like_any_other() -> None:
    config = make_config("medium", world={"pool_size": 7}, train={"seed": 3})
    assert (config.world.name, config.world.pool_size, config.train.seed) == ("medium", 7, 3)
    assert make_config(world={"name": "paper"}) == make_config("paper")
    with pytest.raises(ConfigError, match="'world' must hold keys such as"):
        make_config(world="medium")  # type: ignore[arg-type]


def test_random_worlds_have_drawn_looks_and_files_the_plaid() -> None:
    """On both kinds of hardware, and unless an option says otherwise."""
    for hardware in ("cpu", "gpu"):
        looks = {
            world: make_config(world, tuned_for=hardware).surface.pattern for world in ("medium", "mixed", "paper")
        }
        assert looks == {"medium": "drawn", "mixed": "drawn", "paper": "plaid"}
    assert make_config("medium", surface={"pattern": "plaid"}).surface.pattern == "plaid"
