"""Limits of every option, checked before anything is written."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Iterable

from edqn_jax.config.options import (
    LOOKS,
    AgentConfig,
    AirConfig,
    BodyConfig,
    CameraConfig,
    Config,
    DroneConfig,
    EncoderConfig,
    EnvConfig,
    EventsConfig,
    ExposureConfig,
    LightConfig,
    MotorsConfig,
    NoiseConfig,
    PqnConfig,
    SurfaceConfig,
    TrainConfig,
    WorldConfig,
)
from edqn_jax.config.registry import ACTION_SETS, AIRFRAMES, FAMILIES, FIRST, LEARNERS, NETWORKS, SENSORS
from edqn_jax.errors import ConfigError


def validate(config: Config, *, trains: bool = True) -> None:
    """Raises ConfigError if the configuration is invalid.

    Args:
        config: all options.
        trains: whether it must be one that a policy can be trained with, not only flown.

    Raises:
        ConfigError: names the first option that is out of its limits, and the limits.
    """
    _world(config.world)
    _drone(config.drone)
    _camera(config.camera)
    _surface(config.surface)
    _events(config.events, config.drone)
    _env(config.env)
    _air(config.air)
    _body(config.body)
    _motors(config.motors)
    _noise(config.noise)
    _light(config.light)
    _exposure(config)
    _encoder(config.encoder)
    _agent(config.agent)
    _train(config.train)
    if config.env.drones > 1:
        _several_drones(config, trains)
    if trains:
        _potential(config)
    SENSORS.check(config.env.sensor)
    AIRFRAMES.check(config.drone.airframe)
    LEARNERS.check(config.agent.learner)
    NETWORKS.check(config.agent.network)
    ACTION_SETS.check(config.env.actions)
    _replay(config.agent, config.train)
    _pqn(config.pqn)
    _samples(config.encoder, config.train)
    judged = not config.world.flown or config.train.validation_missions >= 2
    limit = "at least 2 with world.flown, whose flight takes the place of one test world"
    _require(judged, "train.validation_missions", limit, config.train.validation_missions)
    if config.agent.turn and config.world.name not in FAMILIES:
        raise ConfigError(
            f"agent.turn needs a random world ({', '.join(FAMILIES)}, or {FIRST}), not '{config.world.name}': "
            "give --agent.no-turn, or turn: false in a file"
        )


def check_learns(config: Config) -> None:
    """Raises unless the learners of the package can learn what the configuration flies.

    Raises:
        ConfigError: if actions are not moves.
    """
    if config.env.actions != "moves":
        raise ConfigError(
            f"agent.learner '{config.agent.learner}' chooses among moves: env.actions must be moves for training, not "
            f"{config.env.actions}; docs/howto/continuous_actions.md says what learns with those"
        )


def _world(world: WorldConfig) -> None:
    _positive(world, "world", ["pool_size", "missions"])
    _at_most(world, "world", ["pool_size", "missions"], 1_000_000)
    _share(world, "world", ["own_start_fraction"])
    _not_negative(world, "world", ["start_jitter_m"])
    _share(world, "world", ["moving_share"])
    _positive(world, "world", ["moving_speed_m_s"])
    _not_negative(world, "world", ["balls", "ball_gravity_m_s2"])
    # A random start is free of what moves as fast as this for the first two seconds (`sim/worlds/free_points.py`).
    _at_most(world, "world", ["moving_speed_m_s"], 5)
    _at_most(world, "world", ["ball_speed_m_s"], 100)
    # Of 1.5 s at least: balls are launched 3 m away or further.
    _require(world.ball_speed_m_s >= 2, "world.ball_speed_m_s", "at least 2", world.ball_speed_m_s)
    _at_most(world, "world", ["balls"], 64)
    if (world.moving_share or world.balls) and world.name not in FAMILIES:
        option = "moving_share" if world.moving_share else "balls"
        raise ConfigError(
            f"world.{option} is for random worlds ({', '.join(FAMILIES)}) alone; in '{world.name}' the file says what "
            f"moves: give --world.{option.replace('_', '-')} 0"
        )
    if not world.name:
        raise ConfigError("world.name must be the name of a world, not empty")
    if world.flown and world.name not in FAMILIES:
        raise ConfigError(
            f"world.flown is for random worlds ({', '.join(FAMILIES)}, or {FIRST}) alone, '{world.name}' is flown "
            "itself: give --world.flown '', or flown: '' in a file"
        )
    if world.flown in FAMILIES:
        raise ConfigError(f"world.flown must be `paper` or an MJCF file, not the random world '{world.flown}'")


def _drone(drone: DroneConfig) -> None:
    _positive(
        drone, "drone", [field.name for field in dataclasses.fields(drone) if field.name not in ("physics", "airframe")]
    )
    tilt, descent = drone.max_tilt_rad, drone.max_descent_m_s2
    _require(tilt < math.pi / 2, "drone.max_tilt_rad", "less than pi/2", tilt)
    _require(descent < 9.81, "drone.max_descent_m_s2", "less than gravity, 9.81", descent)


def _camera(camera: CameraConfig) -> None:
    _positive(camera, "camera", ["width", "height", "samples_across", "samples_down", "texture_period_m"])
    _at_most(camera, "camera", ["width", "height"], 1024)
    _at_most(camera, "camera", ["samples_across", "samples_down"], 16)
    _share(camera, "camera", ["ambient"])
    _within(camera, "camera", ["horizontal_fov_deg"], 1.0, 170.0)
    _within(camera, "camera", ["sun_elevation_deg"], 0.0, 90.0)
    _finite(camera, "camera", ["sun_azimuth_deg"])
    contrast = camera.texture_contrast
    _require(0 <= contrast < 1, "camera.texture_contrast", "at least 0 and less than 1", contrast)
    bright = all(0 <= value <= 1 for value in camera.sky_rgb)
    _require(bright, "camera.sky_rgb", "three shares between 0 and 1", camera.sky_rgb)


def _surface(surface: SurfaceConfig) -> None:
    near = difflib.get_close_matches(surface.pattern, LOOKS, n=1)
    known = f"; did you mean '{near[0]}'?" if near else f"; it must be one of {', '.join(LOOKS)}"
    if surface.pattern not in LOOKS:
        raise ConfigError(f"surface.pattern: there is no pattern '{surface.pattern}'{known}")
    _share(surface, "surface", ["contrast"])
    _within(surface, "surface", ["shortest_m", "longest_m"], 0.05, 100.0)
    spans = surface.shortest_m <= surface.longest_m
    _require(spans, "surface.longest_m", f"at least surface.shortest_m, {surface.shortest_m:g}", surface.longest_m)


def _events(events: EventsConfig, drone: DroneConfig) -> None:
    thresholds = ["threshold", "tolerance", "contrast_on", "contrast_off", "airsim_tolerance", "log_epsilon"]
    _positive(events, "events", [*thresholds, "refractory_ns", "reference_lux"])
    _not_negative(events, "events", ["threshold_mismatch", "leak_rate_hz", "shot_rate_hz", "hot_pixel_rate_hz"])
    _not_negative(events, "events", ["bandwidth_hz"])
    _share(events, "events", ["hot_pixel_fraction"])
    times = events.frame_times_s
    name, dt = "events.frame_times_s", drone.physics_dt_s
    window = drone.physics_steps * dt
    _require(len(times) >= 2, name, "at least two times, the last 0", times)
    _require(times[-1] == 0, name, "times that end at 0, the decision", times)
    rising = all(earlier < later for earlier, later in zip(times, times[1:], strict=False))
    _require(rising, name, "times in rising order", times)
    # 0.26 / 0.02 is not exactly 13 in floating point, so a thousandth of a step is allowed.
    whole = all(abs(time / dt - round(time / dt)) < 1e-3 for time in times)
    _require(whole, name, f"multiples of drone.physics_dt_s ({dt:g} s)", times)
    _require(times[0] >= -window - 1e-3 * dt, name, f"within the decision's {window:g} s", times)
    gapless = not events.stream or times[0] <= -window + 1e-3 * dt
    _require(gapless, name, f"times that begin at -{window:g}, with the decision, where events.stream is on", times)


def _env(env: EnvConfig) -> None:
    _positive(env, "env", ["speed_m_s", "goal_radius_m", "max_decisions"])
    _not_negative(env, "env", ["heading_hold_m", "progress_weight", "path_weight"])
    known = env.heading == "goal" or not env.position
    _require(known, "env.position", "false with env.heading flight", env.position)
    _share(env, "env", ["potential_discount"])
    _finite(env, "env", ["goal_reward", "collision_reward", "left_volume_reward", "step_reward"])
    _require(env.action_delay in (0, 1), "env.action_delay", "0 or 1", env.action_delay)
    _require(1 <= env.drones <= 8, "env.drones", "from 1 to 8", env.drones)


def _potential(config: Config) -> None:
    gamma = config.agent.discount
    same = config.env.reward != "potential" or config.env.potential_discount == gamma
    limit = f"{gamma:g}, agent.discount, with env.reward potential"
    _require(same, "env.potential_discount", limit, config.env.potential_discount)


def _several_drones(config: Config, trains: bool) -> None:
    env, train, drones = config.env, config.train, f"with env.drones {config.env.drones}"
    _require(not config.world.balls, "world.balls", f"0 {drones}: balls are thrown at one drone", config.world.balls)
    if not trains:
        return
    name = config.world.name
    _require(name in FAMILIES, "world.name", f"a random world ({', '.join(FAMILIES)}) {drones}", f"'{name}'")
    _require(env.reward != "geodesic", "env.reward", f"sparse, progress or potential {drones}", env.reward)
    _require(not train.debug, "train.debug", f"false {drones}", train.debug)
    # A group never spans two shards, so no device has a part of one.
    for option, value, unit in (
        ("train.num_envs", train.num_envs, env.drones * train.shards),
        ("train.validation_missions", train.validation_missions, env.drones),
        ("world.missions", config.world.missions, env.drones),
    ):
        _require(value % unit == 0, option, f"a multiple of {unit} {drones}", value)
    if config.world.flown:
        least, count = 2 * env.drones, train.validation_missions
        _require(count >= least, "train.validation_missions", f"at least {least} {drones} and world.flown", count)


def _air(air: AirConfig) -> None:
    _not_negative(air, "air", ["linear_drag_kg_s", "drag_area_m2"])
    _within(air, "air", ["wind_m_s", "gusts_m_s"], 0.0, 100.0)
    # What MIL-F-8785C has formulas for: 10 to 1000 feet.
    _within(air, "air", ["gust_height_m"], 3.048, 304.8)
    _within(air, "air", ["gust_airspeed_m_s"], 0.1, 100.0)


def _body(body: BodyConfig) -> None:
    _deviation(body, "body", ["mass_share", "inertia_share"])


def _motors(motors: MotorsConfig) -> None:
    _deviation(motors, "motors", ["gain_share"])
    _not_negative(motors, "motors", ["lag_s"])


def _noise(noise: NoiseConfig) -> None:
    _not_negative(noise, "noise", ["position_m", "velocity_m_s", "position_bias_m", "velocity_bias_m_s"])


def _light(light: LightConfig) -> None:
    _not_negative(light, "light", ["least_lux", "most_lux"])
    least, most = light.least_lux, light.most_lux
    if (least, most) != (0.0, 0.0):
        _within(light, "light", ["least_lux", "most_lux"], 0.1, 10_000.0)
        _require(least <= most, "light.least_lux", f"at most light.most_lux ({most:g})", least)


def _exposure(config: Config) -> None:
    exposure: ExposureConfig = config.exposure
    _positive(exposure, "exposure", ["shortest_s", "longest_s", "sub_frames", "sensitivity_e_lux_s", "full_well_e"])
    _not_negative(exposure, "exposure", ["read_noise_e"])
    _at_most(exposure, "exposure", ["sub_frames"], 64)
    _require(0 < exposure.target < 1, "exposure.target", "more than 0 and less than 1", exposure.target)
    _within(exposure, "exposure", ["most_gain"], 1.0, 1000.0)
    longest = f"at most exposure.longest_s ({exposure.longest_s:g})"
    _require(exposure.shortest_s <= exposure.longest_s, "exposure.shortest_s", longest, exposure.shortest_s)
    if not exposure.real:
        return
    _require(config.light.most_lux > 0, "exposure.real", "false without light.least_lux and light.most_lux", True)
    # Poses are known from the beginning of a decision on, and an exposure reaches into whole physics steps.
    dt = config.drone.physics_dt_s
    before = round(config.drone.physics_steps + config.events.frame_times_s[0] / dt) * dt
    limit = f"at most {before:g}, the seconds of a decision before events.frame_times_s"
    _require(exposure.longest_s <= before + 1e-3 * dt, "exposure.longest_s", limit, exposure.longest_s)


def _encoder(encoder: EncoderConfig) -> None:
    _positive(encoder, "encoder", ["code_size", "features", "hidden", "learning_rate", "hold_decisions"])
    _not_negative(encoder, "encoder", ["time_frequencies", "target_blur", "kl_weight", "warmup_decisions"])
    _positive(encoder, "encoder", ["warmup_updates_per_step", "patch_pixels", "batch_size", "replay_size"])
    _positive(encoder, "encoder", ["retrain_decisions"])
    times = encoder.retrain_at
    rising = all(earlier < later for earlier, later in zip(times, times[1:], strict=False))
    inside = rising and all(0 < time < 1 for time in times)
    _require(inside, "encoder.retrain_at", "shares between 0 and 1 in rising order", times)
    warmed = not times or encoder.warmup_decisions > 0
    _require(
        warmed, "encoder.warmup_decisions", "at least 1 where encoder.retrain_at is given", encoder.warmup_decisions
    )
    for key in ("patch_layers", "joint_layers", "decoder_hidden"):
        _widths(getattr(encoder, key), f"encoder.{key}")
    share = encoder.decoder_bandwidth
    _require(0 < share <= 1, "encoder.decoder_bandwidth", "more than 0 and at most 1", share)


def _agent(agent: AgentConfig) -> None:
    _positive(agent, "agent", ["history", "n_step", "batch_size", "updates_per_step", "replay_size"])
    _positive(agent, "agent", ["learning_rate", "reward_scale", "code_scale"])
    _not_negative(agent, "agent", ["final_learning_rate", "huber_delta"])
    _not_negative(agent, "agent", ["learning_starts", "random_decisions", "exploration_episodes"])
    _share(agent, "agent", ["discount", "exploration_start", "exploration_end", "exploration_fraction"])
    for key in ("target_rate", "average_rate"):
        rate = getattr(agent, key)
        _require(0 < rate <= 1, f"agent.{key}", "more than 0 and at most 1", rate)
    norm = agent.max_gradient_norm
    _require(norm > 0, "agent.max_gradient_norm", "more than 0 (inf clips nothing)", norm)
    falls = agent.exploration_end <= agent.exploration_start
    limit = f"at most agent.exploration_start ({agent.exploration_start:g})"
    _require(falls, "agent.exploration_end", limit, agent.exploration_end)
    _widths(agent.hidden, "agent.hidden")


def _train(train: TrainConfig) -> None:
    _positive(train, "train", ["num_envs", "total_steps", "chunk_steps", "shards"])
    _not_negative(train, "train", ["max_episodes", "devices", "validation_every", "seed", "schedule_steps"])
    _not_negative(train, "train", ["checkpoint_every_s"])
    _positive(train, "train", ["validation_missions", "checkpoints"])
    _at_most(train, "train", ["num_envs", "shards"], 1_000_000)
    _at_most(train, "train", ["validation_missions", "chunk_steps"], 100_000)
    limit = f"0 or at most train.total_steps ({train.total_steps})"
    _require(train.schedule_steps <= train.total_steps, "train.schedule_steps", limit, train.schedule_steps)
    _require(train.seed < 2**32, "train.seed", "less than 2**32", train.seed)
    shards, envs = train.shards, train.num_envs
    multiple = f"a multiple of train.shards ({shards}), such as {-(-envs // shards) * shards}"
    _require(envs % shards == 0, "train.num_envs", multiple, envs)
    if train.devices:
        divides = f"0 or a divisor of train.shards ({shards})"
        _require(shards % train.devices == 0, "train.devices", divides, train.devices)
    _require(not train.debug or train.devices <= 1, "train.devices", "0 or 1 with train.debug", train.devices)


def _pqn(pqn: PqnConfig) -> None:
    _positive(pqn, "pqn", ["rollout", "epochs", "minibatches"])
    _share(pqn, "pqn", ["trace"])
    _require(0 < pqn.average_rate <= 1, "pqn.average_rate", "more than 0 and at most 1", pqn.average_rate)


def _replay(agent: AgentConfig, train: TrainConfig) -> None:
    size, batch = agent.replay_size, agent.batch_size
    _require(size >= batch, "agent.replay_size", f"at least agent.batch_size ({batch})", size)
    starts = agent.learning_starts
    _require(starts <= size, "agent.learning_starts", f"at most agent.replay_size ({size})", starts)
    shards = train.shards
    multiple = f"a multiple of train.shards ({shards}), such as {-(-batch // shards) * shards}"
    _require(batch % shards == 0, "agent.batch_size", multiple, batch)
    # A sample reads its history, its n steps and the observation after them from the rows of one environment.
    rows = agent.history + agent.n_step + 1
    needed = rows * train.num_envs
    limit = f"at least {needed}: {rows} observations for each of the {train.num_envs} environments"
    _require(size >= needed, "agent.replay_size", limit, size)


def _samples(encoder: EncoderConfig, train: TrainConfig) -> None:
    batch, shards = encoder.batch_size, train.shards
    multiple = f"a multiple of train.shards ({shards}), such as {-(-batch // shards) * shards}"
    _require(batch % shards == 0, "encoder.batch_size", multiple, batch)


def _require(holds: bool, name: str, limits: str, value: object) -> None:
    if not holds:
        said = ", ".join(map(_short, value)) or "an empty list" if isinstance(value, tuple) else shown(value)
        raise ConfigError(f"{name} must be {limits}, not {said}")


def shown(value: object) -> str:
    """Returns a value as text; a whole number of very many digits without them."""
    return "a huge number" if isinstance(value, int) and abs(value) >= 10**18 else str(value)


def _short(value: object) -> str:
    """Returns an item of a list as text."""
    return f"{value:g}" if isinstance(value, float) else shown(value)


def _positive(section: object, group: str, keys: Iterable[str]) -> None:
    for key in keys:
        value = getattr(section, key)
        limits = "at least 1" if isinstance(value, int) else "more than 0"
        _require(0 < value < math.inf, f"{group}.{key}", limits, value)


def _at_most(section: object, group: str, keys: Iterable[str], most: int) -> None:
    """Refuses sizes that no machine has memory for, before anything of them is made."""
    for key in keys:
        value = getattr(section, key)
        _require(value <= most, f"{group}.{key}", f"at most {most}", value)


def _not_negative(section: object, group: str, keys: Iterable[str]) -> None:
    for key in keys:
        value = getattr(section, key)
        _require(0 <= value < math.inf, f"{group}.{key}", "0 or more", value)


def _within(section: object, group: str, keys: Iterable[str], low: float, high: float) -> None:
    for key in keys:
        value = getattr(section, key)
        _require(low <= value <= high, f"{group}.{key}", f"between {low:g} and {high:g}", value)


def _share(section: object, group: str, keys: Iterable[str]) -> None:
    _within(section, group, keys, 0.0, 1.0)


def _deviation(section: object, group: str, keys: Iterable[str]) -> None:
    """Refuses deviations that could leave nothing of a positive number."""
    for key in keys:
        value = getattr(section, key)
        _require(0 <= value < 1, f"{group}.{key}", "at least 0 and less than 1", value)


def _finite(section: object, group: str, keys: Iterable[str]) -> None:
    for key in keys:
        value = getattr(section, key)
        _require(math.isfinite(value), f"{group}.{key}", "a finite number", value)


def _widths(widths: tuple[int, ...], name: str) -> None:
    _require(len(widths) > 0 and min(widths, default=0) > 0, name, "one or more widths of at least 1", widths)
