"""Model cards of the policies that come with the package, as `pretrain.py` writes them.

A policy of one plaid has a card with a row for each family of worlds, one of any look a card with a row for each look
and a column for each family. `PLACES` are the parts of the latter that other commands measure: a file of Markdown has
them, so that they stay when a card is made anew.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import edqn_jax
from edqn_jax.config import MIXTURES, Config
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.evaluate import Evaluation
from edqn_jax.learn.policy import Policy
from edqn_jax.policies import SHIPPED
from edqn_jax.sim.task.outcomes import Outcome
from edqn_jax.sim.worlds.looks import TRAINED


@dataclass(frozen=True)
class Origin:
    """Where a policy comes from, and where it is kept."""

    folder: Path
    """Of the policy and its card."""
    kind: str
    """`--kind` of pretrain.py."""
    validations: Mapping[int, float]
    """Success in the validation worlds by training seed."""
    arrived: int
    """Number of these seeds that reach the goal of the paper's map."""
    trained: str
    """Where and how long."""
    commit: str
    """That it was trained at."""
    began_with: Path | None = None
    """Policy whose networks it began with."""

    @property
    def name(self) -> str:
        """What `edqn evaluate` is given."""
        return self.folder.name if self.folder.name in SHIPPED else self.folder.as_posix()


HEAD = """# Model card: `{title}`

{about}
`edqn evaluate {name} --world FILE.xml` flies it, `edqn_jax.load_policy("{name}")` loads it.

| | |
| --- | --- |
{rows}

## Measured

"""

PLAID = """Greedy flights through test worlds, which neither training nor any choice has used; physics by MJX.

| world | missions | success | 95 % interval (Wilson) | SPL | collisions | other failures |
| --- | ---: | ---: | ---: | ---: | ---: | ---: |
{rows}

The paper's own map, never trained on: {paper}

## Limits

- {seeds}
- Simulated events from rendered brightness: no noise, no lens, uniform thresholds, static worlds, no wind. It has not
  been flown on a real drone, and must not be.
- The map's bounds matter: the own position is given relative to the flight volume, and only worlds of these
  families' sizes have been measured: 110 x 110 x 25 m open ones, 36 to 60 m across closed ones.
- It collides with obstacles in full view and with ones just outside of the camera's view:
  `benchmarks/failures.py {name} --world medium` lists them.
"""

LOOKS = """Greedy flights through {missions:,} test worlds of each family, with the sensor that it was trained with and
without errors of tracking; reached the goal, % (Wilson's 95 % interval;
`python benchmarks/looks.py --policy {name} --world FAMILY --missions {missions} --seed {seed} --exact`):

{success}

{ends}

{decoder}The paper's own map, never trained on, in the look `{trained_look}`: {paper}

{places}

## Limits

{limits}
"""

PLACES: dict[str, str] = {
    "True depth and blind": "`train.py` with the options of this policy and `--env.sensor depth`, or `blind`, and "
    "`python benchmarks/looks.py --policy RUN --world FAMILY --missions {missions} --seed {seed} --exact`",
    "Verdicts": "`python benchmarks/verdicts.py {folder} --world FAMILY --missions 200 --seed {seed}`",
    "Outer test": "`python benchmarks/transfer.py --policy {name} --world FAMILY --picture mujoco --look plain "
    "--events esim --flight rotorpy --missions 200`",
    "Over the wire": "`edqn fly {name} --simulate FAMILY --missions 100`",
}
"""Sections of a card that other commands measure, each with its command."""

LIMITS = "Limits"
"""Section of a file of measurements whose text becomes further limits."""


def plaid_card(policy: Policy, origin: Origin, flown: Mapping[str, Evaluation], paper: Evaluation) -> str:
    """Returns the card of a policy of one plaid.

    Args:
        policy: the best of its seeds.
        origin: where it comes from.
        flown: its flights by family.
        paper: its flight through the paper's map.
    """
    rows = []
    for world, evaluation in flown.items():
        found = evaluation.figures
        low, high = found["interval"]
        others = found["left_volume"] + found["timeouts"] + found["diverged"]
        rows.append(
            f"| {world} | {found['missions']} | {found['success_rate']:.1%} | {low:.1%} to {high:.1%} "
            f"| {found['spl']:.3f} | {found['collisions']} | {others} |"
        )
    about = f"A policy for random worlds ({', '.join(flown)}), flown from simulated events."
    measured = PLAID.format(
        rows="\n".join(rows), paper=_paper(paper, policy.config), seeds=_seeds(origin), name=origin.name
    )
    return _head(policy.config, origin, about) + measured


def looks_card(
    policy: Policy,
    origin: Origin,
    flown: Mapping[str, Mapping[str, Evaluation]],
    paper: Evaluation,
    seed: int,
    measured: Mapping[str, str],
) -> str:
    """Returns the card of a policy of any look.

    Args:
        policy: the best of its seeds.
        origin: where it comes from.
        flown: its flights by look and family, as many in each.
        paper: its flight through the paper's map.
        seed: of the test missions.
        measured: what other commands measured, see `sections_of`.
    """
    config = policy.config
    families = list(next(iter(flown.values())))
    whose = "with a camera on the body, " if config.camera.mount == "body" else ""
    about = (
        f"A policy for random worlds ({', '.join(families)}) whose surfaces look otherwise in each, {whose}flown from "
        "simulated events."
    )
    missions = next(iter(next(iter(flown.values())).values())).figures["missions"]
    named = {"name": origin.name, "folder": origin.folder.as_posix(), "missions": missions, "seed": seed}
    body = LOOKS.format(
        **named,
        success=_table(flown, _success),
        ends=_ends(flown, config.surface.pattern),
        decoder=_decoder(flown),
        trained_look=config.surface.pattern,
        paper=_paper(paper, config),
        places=_places(measured, named),
        limits="\n".join([*(f"- {each}" for each in _limits(config, origin)), *filter(None, [measured.get(LIMITS)])]),
    )
    return _head(config, origin, about) + body


def sections_of(text: str) -> dict[str, str]:
    """Returns the parts of a file of measurements by their headings `### NAME`; "" is what stands above them.

    Raises:
        ConfigError: if a heading is of another level, occurs twice, or has no text below it.
    """
    parts = re.split(r"^(#+ .*)$", text, flags=re.MULTILINE)
    found = {"": parts[0].strip()} if parts[0].strip() else {}
    for heading, part in zip(parts[1::2], parts[2::2], strict=True):
        level, _, name = heading.partition(" ")
        if level != "###":
            raise ConfigError(f"measurements have headings of the third level, such as '### Verdicts', not '{heading}'")
        if name in found or not part.strip():
            raise ConfigError(f"'{heading}' of the measurements must stand once, with text below it")
        found[name] = part.strip()
    if not found:
        raise ConfigError("the file of measurements is empty")
    return found


def _head(config: Config, origin: Origin, about: str) -> str:
    rows = {
        "trained on": _worlds(config),
        "training": _training(config, origin),
        "seed": _seed(config, origin),
        "sees": _sees(config),
        **_disturbed(config),
        "camera": _camera(config),
        "format": "configuration in `config.yaml`, parameters in `checkpoints/policy.safetensors` (arrays, no pickle)",
        "trained at": f"commit `{origin.commit}`, with the options in `config.yaml`",
        "made by": f"`{_command(config, origin)}`, which trains with these options, edqn_jax {edqn_jax.__version__}",
    }
    return HEAD.format(
        title=origin.folder.name,
        name=origin.name,
        about=about,
        rows="\n".join(f"| {what} | {said} |" for what, said in rows.items()),
    )


def _command(config: Config, origin: Origin) -> str:
    """Returns what trains the policy anew, without folders of its own."""
    begin = f" --start-from {origin.began_with.as_posix()}" if origin.began_with else ""
    seeds = f" --seeds {len(origin.validations)} --first-seed {min(origin.validations)}"
    return f"scripts/pretrain.py --kind {origin.kind} --world {config.world.name}{begin}{seeds}"


def _worlds(config: Config) -> str:
    name = config.world.name
    shares = MIXTURES.get(name, {})
    mixed = f": {', '.join(f'{family} {share}' for family, share in shares.items())}" if shares else ""
    return (
        f"{config.world.pool_size:,} worlds (`--world {name} --surface.pattern {config.surface.pattern}`{mixed}; the "
        f"training split), {config.world.missions:,} missions"
    )


def _training(config: Config, origin: Origin) -> str:
    begun = f", from `{origin.began_with.as_posix()}`" if origin.began_with else ""
    return (
        f"{config.train.total_steps:,} decisions in {config.train.num_envs:,} environments{begun}, last averaged "
        f"parameters; {origin.trained}"
    )


def _seed(config: Config, origin: Origin) -> str:
    said = ", ".join(f"{seed}: {success:.1%}" for seed, success in origin.validations.items())
    which = "the only one" if len(origin.validations) == 1 else f"the best of {len(origin.validations)}"
    return f"{config.train.seed}, {which} in {config.train.validation_missions} validation worlds ({said})"


def _seeds(origin: Origin) -> str:
    count = len(origin.validations)
    if count == 1:
        return "One training seed: how much another would differ is not known."
    return f"The best of {count} training seeds, of which {origin.arrived} reach the goal of the paper's map."


def _sees(config: Config) -> str:
    events, times = config.events, config.events.frame_times_s
    windows = [f"{end - begin:g} s" for begin, end in zip(times[:-1], times[1:], strict=True)]
    if len(windows) == 1:
        said = f"events of the last {windows[0]}"
    else:
        said = f"events of {len(windows)} windows of {' and '.join(dict.fromkeys(windows))}"
    if not events.most_contrast:
        said += f" (threshold {events.threshold:g})"
    if config.encoder.levelled:
        said += ", moved to where a level camera would have them"
    own = ", its own state, motion and last move" if config.agent.last_move else ", its own state and motion"
    if config.camera.mount == "body":
        own += ", roll and pitch at each frame"
    return said + own + (", the contrast of its sensor" if events.most_contrast else "")


def _disturbed(config: Config) -> dict[str, str]:
    """Returns the rows of the sensor and of errors of tracking, without those that were off in training."""
    events, rows = config.events, {}
    sensor = []
    if events.sensor_pixels > 1:
        sensor.append(f"{events.sensor_pixels} pixels for each of its own")
    if events.most_contrast:
        sensor.append(f"contrast {events.least_contrast:g} to {events.most_contrast:g}, log-uniform")
    if events.profile != "ideal":
        drawn = f", {100 * (1 - events.faults_share):.0f} to 100 % of them" if events.faults_share else ""
        sensor.append(f"faults of `{events.profile}`{drawn}")
    if sensor:
        rows["sensor"] = f"{'; '.join(sensor)}; what differs is drawn for each episode"
    env, errors = config.env, []
    if config.air.drag:
        errors.append("drag")
    shares = {
        "mass": config.body.mass_share,
        "inertia": config.body.inertia_share,
        "thrust of each rotor": config.motors.gain_share,
    }
    errors += [f"{what} off by up to {share:.0%}" for what, share in shares.items() if share]
    if config.motors.lag_s:
        errors.append(f"motors that lag by up to {config.motors.lag_s:g} s")
    if env.action_delay:
        errors.append(f"a delay of one decision in {env.delay_share:.0%} of the episodes")
    if env.setpoint_m_s2:
        errors.append(
            f"a velocity that changes by {env.setpoint_m_s2:g} m/s² or more in {env.setpoint_share:.0%} of the episodes"
        )
    if errors:
        rows["errors of tracking"] = f"{', '.join(errors)}; drawn for each episode"
    if env.closeness_weight:
        rows["closeness"] = f"costs {env.closeness_weight:g} within {env.closeness_m:g} m (`env.closeness_weight`)"
    return rows


def _camera(config: Config) -> str:
    camera = config.camera
    mount = {"level": "level", "body": "on the body"}[camera.mount]
    return f"{mount}, {camera.width} x {camera.height} pixels, {camera.horizontal_fov_deg:g} degrees across"


def _limits(config: Config, origin: Origin) -> list[str]:
    camera, pixels = config.camera, config.events.sensor_pixels
    limits = [_seeds(origin)]
    if pixels > 1:
        limits.append(f"Not for a sensor of {camera.width} x {camera.height} pixels: it expects the mean of {pixels}.")
    if camera.mount == "level":
        limits.append("A level camera, as a gimbal makes it.")
    absent = [] if config.world.moving_share or config.world.balls else ["static worlds"]
    absent += [] if config.air.wind_m_s or config.air.gusts_m_s else ["no wind in training"]
    if absent:
        limits.append(f"{', '.join(absent).capitalize()}.")
    return [*limits, "It has not been flown on a real drone, and must not be."]


def _places(measured: Mapping[str, str], named: Mapping[str, Any]) -> str:
    """Returns the sections that other commands measure; of those that nobody did, the command."""
    first = [measured[""]] if "" in measured else []
    known = {place: measured.get(place, f"Not measured: {how.format(**named)}.") for place, how in PLACES.items()}
    others = {name: text for name, text in measured.items() if name not in ("", LIMITS, *PLACES)}
    return "\n\n".join([*first, *(f"### {name}\n\n{text}" for name, text in {**known, **others}.items())])


def _table(flown: Mapping[str, Mapping[str, Evaluation]], cell: Callable[[dict[str, Any]], str]) -> str:
    """Returns a table with a row for each look and a column for each family."""
    families = list(next(iter(flown.values())))
    lines = [f"| look | {' | '.join(families)} |", f"| --- |{' ---: |' * len(families)}"]
    for look, there in flown.items():
        lines.append(f"| `{look}` | {' | '.join(cell(there[family].figures) for family in families)} |")
    return "\n".join(lines)


def _success(figures: dict[str, Any]) -> str:
    low, high = figures["interval"]
    return f"{100 * figures['success_rate']:.1f} ({100 * low:.1f}–{100 * high:.1f})"


def _error(figures: dict[str, Any]) -> str:
    errors = (figures["decoder"][f"relative_{which}"] for which in ("median", "p90"))
    return ", ".join("–" if error is None else f"{error:.0%}" for error in errors)


def _decoder(flown: Mapping[str, Mapping[str, Evaluation]]) -> str:
    """Returns the paragraph on the error of predicted distance; empty without a decoder that predicts it."""
    first = next(iter(next(iter(flown.values())).values())).figures
    if "decoder" not in first:
        return ""
    near = first["decoder"]["near_m"]
    return (
        f"Error of the distance that the decoder predicts in these flights, over pixels nearer than {near:g} m, "
        f"relative to the true one; median, 90th percentile:\n\n{_table(flown, _error)}\n\n"
    )


def _ends(flown: Mapping[str, Mapping[str, Evaluation]], look: str) -> str:
    """Returns how flights failed, and how much room those that arrived kept under the look of training, `drawn`."""
    all_figures = [evaluation.figures for there in flown.values() for evaluation in there.values()]
    collisions, out, late, diverged = (
        sum(figures[kind] for figures in all_figures) for kind in ("collisions", "left_volume", "timeouts", "diverged")
    )
    said = (
        f"Of all flights, {collisions} ended in a collision, {out} outside of the volume, {late} by time, and "
        f"{diverged} diverged."
    )
    unseen = [f"`{name}`" for name in flown if name not in (look, *TRAINED)]
    if unseen:
        said += f" Never trained on: {', '.join(unseen)}."
    if look in flown:
        kept = [f"{text} in {family}" for family, each in flown[look].items() if (text := _clearance(each))]
        if kept:
            said += f" Half of the `{look}` flights that arrive keep at least, metres from all: {', '.join(kept)}."
    return said


def _clearance(evaluation: Evaluation) -> str:
    """Returns the median of the least clearance of the flights that arrived, metres; empty where none did."""
    success = np.asarray(evaluation.flights.outcome) == Outcome.GOAL
    if not success.any():
        return ""
    return f"{float(np.median(np.asarray(evaluation.flights.closest.distance)[success])):.2f}"


def _paper(paper: Evaluation, config: Config) -> str:
    figures, radius = paper.figures, config.drone.body_radius_m
    if not figures["successes"]:
        return "it does not reach the goal."
    return (
        f"it reaches the goal after {figures['decisions']:.0f} decisions (the paper: 188), "
        f"{figures['path_length_m']:.1f} m ({figures['path_over_shortest']:.2f} times A*'s path), with "
        f"{figures['min_clearance_m']:.2f} m "
        f"({figures['min_clearance_m'] / radius:.1f} body radii) to spare."
    )
