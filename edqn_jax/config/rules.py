"""Rules between options, checked with the limits of each before anything is written."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from edqn_jax.config.limits import between, check_limits, require
from edqn_jax.config.options import Config
from edqn_jax.config.registry import ACTION_SETS, AIRFRAMES, ENCODERS, FAMILIES, LEARNERS, NETWORKS, OWN, SENSORS
from edqn_jax.config.simulation import EventsConfig
from edqn_jax.errors import ConfigError

Rules = Iterator[tuple[bool, str, str]]
"""Whether each rule holds, the option that breaks it, and what that must be."""


def validate(config: Config, *, trains: bool = True) -> None:
    """Raises ConfigError if the configuration is invalid.

    Args:
        config: all options.
        trains: whether it must be one that a policy can be trained with, not only flown.

    Raises:
        ConfigError: names the first option that is out of its own limits, or else the first that breaks a rule.
    """
    for group in dataclasses.fields(config):
        check_limits(getattr(config, group.name), group.name)
    _check_world(config, trains)
    for registry in (SENSORS, AIRFRAMES, ENCODERS, LEARNERS, NETWORKS, ACTION_SETS):
        registry.check(_value(config, registry.option))
    for rules in (_flight_rules(config, trains), _training_rules(config, trains), _learning_rules(config, trains)):
        for holds, name, limit in rules:
            require(holds, name, limit, _value(config, name))


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


def _value(config: Config, name: str) -> Any:
    """Returns the value of an option `group.name`."""
    group, _, option = name.partition(".")
    return getattr(getattr(config, group), option)


def _check_world(config: Config, trains: bool) -> None:
    """Raises unless the worlds have what other options ask of them."""
    world, families = config.world, ", ".join(FAMILIES)
    if not world.name:
        raise ConfigError("world.name must be the name of a world, not empty")
    if world.name in FAMILIES:
        if world.flown in FAMILIES:
            raise ConfigError(f"world.flown must be `paper` or an MJCF file, not the random world '{world.flown}'")
        return
    if world.moving_share or world.balls:
        option = "moving_share" if world.moving_share else "balls"
        raise ConfigError(
            f"world.{option} is for random worlds ({families}) alone; in '{world.name}' the file says what moves: give "
            f"--world.{option.replace('_', '-')} 0"
        )
    if world.flown:
        raise ConfigError(
            f"world.flown is for random worlds ({families}, or {OWN}) alone, '{world.name}' is flown itself: give "
            "--world.flown '', or flown: '' in a file"
        )
    if trains and config.env.drones > 1:
        raise ConfigError(
            f"world.name must be a random world ({families}) with env.drones {config.env.drones}, not '{world.name}'"
        )
    if config.agent.turn:
        raise ConfigError(
            f"agent.turn needs a random world ({families}, or {OWN}), not '{world.name}': give --agent.no-turn, or "
            "turn: false in a file"
        )


def _flight_rules(config: Config, trains: bool) -> Rules:
    """Yields rules of what is flown and seen."""
    env, light, exposure, times = config.env, config.light, config.exposure, config.events.frame_times_s
    dt, window = config.drone.physics_dt_s, config.drone.physics_steps * config.drone.physics_dt_s
    surface = config.surface
    longest = f"at least surface.shortest_m ({surface.shortest_m:g})"
    yield surface.shortest_m <= surface.longest_m, "surface.longest_m", longest
    # 0.26 / 0.02 is not exactly 13 in floating point, so a thousandth of a step is allowed.
    whole = all(abs(time / dt - round(time / dt)) < 1e-3 for time in times)
    yield whole, "events.frame_times_s", f"multiples of drone.physics_dt_s ({dt:g} s)"
    yield times[0] >= -window - 1e-3 * dt, "events.frame_times_s", f"within the decision's {window:g} s"
    gapless = not config.events.stream or times[0] <= -window + 1e-3 * dt
    limit = f"times that begin at -{window:g}, with the decision, where events.stream is on"
    yield gapless, "events.frame_times_s", limit
    yield env.heading == "goal" or not env.position, "env.position", "false with env.heading flight"
    if (light.least_lux, light.most_lux) != (0.0, 0.0):
        lit = between(0.1, 10_000)
        yield lit.holds(light.least_lux), "light.least_lux", lit.says
        yield lit.holds(light.most_lux), "light.most_lux", lit.says
        least = light.least_lux <= light.most_lux
        yield least, "light.least_lux", f"at most light.most_lux ({light.most_lux:g})"
    held = env.actions != "body-rates" or not env.setpoint_m_s2
    yield held, "env.setpoint_m_s2", "0 with env.actions body-rates: no velocity is held"
    yield light.most_lux > 0 or not light.told, "light.told", "false without light.least_lux and light.most_lux"
    exposed = exposure.real or not (light.told and SENSORS.get(env.sensor).exposes)
    yield exposed, "exposure.real", f"true with light.told and env.sensor {env.sensor}"
    yield from _event_sensor_rules(config.events)
    shortest = exposure.shortest_s <= exposure.longest_s
    yield shortest, "exposure.shortest_s", f"at most exposure.longest_s ({exposure.longest_s:g})"
    clocked = exposure.rate_hz > 0 or exposure.latency_s > 0
    if exposure.rate_hz:
        period = exposure.shortest_s * exposure.rate_hz <= 1
        yield period, "exposure.shortest_s", f"at most {1 / exposure.rate_hz:g}, the period of exposure.rate_hz"
    if exposure.real:
        yield light.most_lux > 0, "exposure.real", "false without light.least_lux and light.most_lux"
        # Poses are known from the beginning of a decision on, and an exposure reaches into whole physics steps.
        before = round(config.drone.physics_steps + times[0] / dt) * dt
        limit = f"at most {before:g}, the seconds of a decision before events.frame_times_s"
        limit = "at most 1 with exposure.rate_hz or exposure.latency_s" if clocked else limit
        yield exposure.longest_s <= (1 if clocked else before + 1e-3 * dt), "exposure.longest_s", limit
    if config.world.balls:
        slowest = config.world.ball_slowest * config.world.ball_speed_m_s
        limit = f"at least {1.5 / slowest:.2g} and more: a ball of {slowest:g} m/s must fly 1.5 m"
        yield slowest * config.world.ball_seconds[0] >= 1.5 - 1e-6, "world.ball_seconds", limit
    if env.drones > 1:
        limit = f"0 with env.drones {env.drones}: balls are thrown at one drone"
        yield not config.world.balls, "world.balls", limit
    if trains:
        gamma = config.agent.discount
        same = env.reward != "potential" or env.potential_discount == gamma
        yield same, "env.potential_discount", f"{gamma:g}, agent.discount, with env.reward potential"


def _event_sensor_rules(events: EventsConfig) -> Rules:
    """Yields rules of event sensors that differ from episode to episode, or average many pixels."""
    if (events.least_contrast, events.most_contrast) != (0.0, 0.0):
        drawn = between(0.01, 1)
        yield drawn.holds(events.least_contrast), "events.least_contrast", drawn.says
        yield drawn.holds(events.most_contrast), "events.most_contrast", drawn.says
        most = f"at most events.most_contrast ({events.most_contrast:g})"
        yield events.least_contrast <= events.most_contrast, "events.least_contrast", most
    one = events.sensor_pixels == 1 or events.law != "airsim"
    yield one, "events.sensor_pixels", "1 with events.law airsim, which has no pixels that differ"


def _learning_rules(config: Config, trains: bool) -> Rules:
    """Yields rules of what learns, and of what it learns from."""
    encoder, agent, envs = config.encoder, config.agent, config.train.num_envs
    leans = not encoder.levelled or (config.camera.mount == "body" and config.env.sensor == "events")
    yield leans, "encoder.levelled", "false unless camera.mount is body and env.sensor is events"
    if agent.learner == "imitation" and trains:
        limit = "the folder of a run with env.sensor depth, for agent.learner imitation"
        yield bool(config.imitation.teacher), "imitation.teacher", limit
        yield not encoder.levelled, "encoder.levelled", "false with agent.learner imitation"
    warmed = not encoder.retrain_at or encoder.warmup_decisions > 0
    yield warmed, "encoder.warmup_decisions", "at least 1 where encoder.retrain_at is given"
    falls = agent.exploration_end <= agent.exploration_start
    yield falls, "agent.exploration_end", f"at most agent.exploration_start ({agent.exploration_start:g})"
    size, batch = agent.replay_size, agent.batch_size
    yield size >= batch, "agent.replay_size", f"at least agent.batch_size ({batch})"
    yield agent.learning_starts <= size, "agent.learning_starts", f"at most agent.replay_size ({size})"
    # A sample reads its history, its n steps and the observation after them from the rows of one environment.
    rows = agent.history + agent.n_step + 1
    limit = f"at least {rows * envs}: {rows} observations for each of the {envs} environments"
    yield size >= rows * envs, "agent.replay_size", limit


def _training_rules(config: Config, trains: bool) -> Rules:
    """Yields rules of a run, its shards, devices and missions."""
    train, drones, shards = config.train, config.env.drones, config.train.shards
    scheduled = train.schedule_steps <= train.total_steps
    yield scheduled, "train.schedule_steps", f"0 or at most train.total_steps ({train.total_steps})"
    sizes = {
        "train.num_envs": train.num_envs,
        "agent.batch_size": config.agent.batch_size,
        "encoder.batch_size": config.encoder.batch_size,
    }
    for name, size in sizes.items():
        multiple = f"a multiple of train.shards ({shards}), such as {-(-size // shards) * shards}"
        yield size % shards == 0, name, multiple
    divides = not train.devices or shards % train.devices == 0
    yield divides, "train.devices", f"0 or a divisor of train.shards ({shards})"
    yield not train.debug or train.devices <= 1, "train.devices", "0 or 1 with train.debug"
    limit = "at least 2 with world.flown, whose flight takes the place of one test world"
    yield not config.world.flown or train.validation_missions >= 2, "train.validation_missions", limit
    if drones == 1 or not trains:
        return
    several = f"with env.drones {drones}"
    yield config.env.reward != "geodesic", "env.reward", f"sparse, progress or potential {several}"
    yield not train.debug, "train.debug", f"false {several}"
    # A group never spans two shards, so no device has a part of one.
    unit = drones * shards
    yield train.num_envs % unit == 0, "train.num_envs", f"a multiple of {unit} {several}"
    yield train.validation_missions % drones == 0, "train.validation_missions", f"a multiple of {drones} {several}"
    yield config.world.missions % drones == 0, "world.missions", f"a multiple of {drones} {several}"
    enough = not config.world.flown or train.validation_missions >= 2 * drones
    yield enough, "train.validation_missions", f"at least {2 * drones} {several} and world.flown"
