"""How fast is training, and where does its time go?

Times the whole training step of the reference workload, with the VAE learning all the time, and each of its
parts alone, beside the least time that the part's arithmetic and memory traffic could take on this machine.
C MuJoCo's own threaded `rollout` of the same airframe takes turns with them, because a shared machine's speed
moves: every row is the median of repeats in which each row ran once.

    python benchmarks/throughput.py --json throughput.json
    python benchmarks/throughput.py -- --num-envs 1024 --agent.updates-per-step 16

What stands after -- goes to the configuration as it would for train.py.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from mujoco import rollout

from edqn_jax.cli import parse_train
from edqn_jax.config import Config, ConfigError
from edqn_jax.devices import choose_devices, compiler_options, cores, processor, use_cpu_devices
from edqn_jax.files import check_can_write, write_whole
from edqn_jax.learn import dqn, encoder, qnetwork, replay, trainer
from edqn_jax.learn.trainer import AXIS, Trainer, TrainState
from edqn_jax.run import lay_courses, versions, workload
from edqn_jax.rundir import plain
from edqn_jax.sim import drone, env, events
from edqn_jax.sim.drone import Flight
from edqn_jax.sim.scene import take_scene

SAMPLES = 4
"""Replayed samples per decision unless the flags say otherwise."""
REPEATS = 5
ENVIRONMENT, LEARNING = "environment", "dqn_update_and_sampling"
TURN_SECONDS = 0.4
"""What a part's turn takes, about."""
ROLLOUT_STEPS = 130
"""Physics steps of C MuJoCo in one turn, for each drone: ten decisions."""


def parse(argv: Sequence[str] | None = None) -> tuple[argparse.Namespace, Config]:
    """The arguments, and the configuration that is timed.

    Raises:
        ConfigError: if the flags after -- cannot be run, or the file cannot be written.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    cut = words.index("--") if "--" in words else len(words)
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").partition("\n")[0], epilog="Flags after -- are train.py's."
    )
    parser.add_argument("--repeats", type=int, default=REPEATS, help=f"turns of each row (default {REPEATS})")
    parser.add_argument("--quick", action="store_true", help="one short turn of each row")
    parser.add_argument("--whole-only", action="store_true", help="leave out the parts and their floors")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    args = parser.parse_args(words[:cut])
    if args.repeats < 1:
        parser.error(f"--repeats must be at least 1, not {args.repeats}")
    if args.json is not None:
        check_can_write(args.json)
    flags = words[cut + 1 :]
    _, config = parse_train(flags)
    if not any(flag.replace("_", "-").startswith(("--agent.updates-per-step", "--config")) for flag in flags):
        updates = math.ceil(SAMPLES * config.train.num_envs / config.agent.batch_size)
        config = dataclasses.replace(config, agent=dataclasses.replace(config.agent, updates_per_step=updates))
    return args, steady(config, 8 if args.quick else config.train.chunk_steps)


def steady(config: Config, chunk_steps: int) -> Config:
    """`config` with the VAE learning throughout and a beginning of two chunks: what follows is all alike."""
    decisions = chunk_steps * config.train.num_envs
    return dataclasses.replace(
        config,
        encoder=dataclasses.replace(config.encoder, keep_learning=True, warmup_decisions=decisions),
        agent=dataclasses.replace(config.agent, learning_starts=min(decisions, config.agent.learning_starts)),
        train=dataclasses.replace(config.train, chunk_steps=chunk_steps, total_steps=1000 * decisions),
    )


# ---------------------------------------------------------------------------------- the whole step


class WholeStep:
    """The training command's own compiled chunk, past its beginning."""

    def __init__(self, config: Config, world: env.World, devices: list[Any]) -> None:
        self.trainer = Trainer(config, world, devices)
        self.decisions = config.train.chunk_steps * config.train.num_envs
        state = self.trainer.init(config.train.seed)
        began = time.perf_counter()
        self.trainer.compile(state)
        self.compile_seconds = time.perf_counter() - began
        self.done = 0
        self.state = state
        while self.done < self.trainer.plan.learn_from:
            self.turn()

    def turn(self) -> float:
        """Decisions per second of one more chunk."""
        began = time.perf_counter()
        self.state, (_, losses) = self.trainer.chunk(self.state, self.done)
        q_loss = np.asarray(losses.q_loss)
        seconds = time.perf_counter() - began
        learns = self.done >= self.trainer.plan.learn_from
        self.done += len(q_loss)
        if learns and not np.isfinite(np.concatenate([q_loss, np.asarray(losses.reconstruction)])).all():
            raise RuntimeError("a timed chunk did not learn throughout")
        return self.decisions / seconds


# --------------------------------------------------------------------------------------- its parts


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of the step for the environments of one device: `body` maps `carry` to the next one."""

    name: str
    body: Callable[[Any, Any], Any]  # (what stays, carry) -> carry
    stays: Any  # read in every turn
    carry: Any  # read and written in every turn
    specs: tuple[Any, Any] = (PartitionSpec(), PartitionSpec(AXIS))  # how both lie on the devices
    scans: int = 1  # how often a scan inside repeats operations that are counted once
    products: bool = False  # whether its arithmetic is matrix products
    floor: bool = True  # whether its operations can be counted: not where only some of them are in a scan
    moved: int | None = None  # bytes that a turn reads and writes at the least; without it, the carry's twice


def nudged(value: Array, *results: Any) -> Array:
    """`value`, in a way that the compiler must compute all of `results` for it."""
    total = sum(jnp.sum(leaf.astype(jnp.float32)) for leaf in jax.tree.leaves(results))
    return jnp.where(total > 1e30, value + 1, value)


def parts_of(config: Config, world: env.World, state: TrainState) -> list[Part]:
    """Every part, on the states that training has come to."""
    flat = partial(jax.tree.map, lambda x: x.reshape(-1, *x.shape[2:]))
    actors, learner = state.actors, state.learner
    environments = flat(actors.env)
    moves = jnp.arange(config.train.num_envs) % len(env.ACTIONS)
    rows, same = PartitionSpec(AXIS), PartitionSpec()
    seen = jax.jit(jax.vmap(lambda s, a: env.step(config, world, s, a)))(environments, moves)[1]
    scenes = world.missions.scene[environments.mission]
    goals = world.missions.goal[environments.mission]
    steps = env.frame_steps(config)

    def physics(world: env.World, carry):
        body, move, goal = carry

        def one(body, move, goal):
            command = env.velocity_command(config.env, move, drone.yaw_of(body.quaternion))
            bearing = jnp.arctan2(goal[1] - body.position[1], goal[0] - body.position[0])
            flown, flight = drone.fly(config.drone, world.airframe, body, command, bearing)
            return flown, flight.position

        flown, path = jax.vmap(one)(body, move, goal)
        return flown, nudged(move, path), goal

    def outcomes(world: env.World, carry):
        before, flight, scene, goal = carry
        judged = jax.vmap(lambda b, f, s, g: env.judge(config, take_scene(world.pool, s), g, b, f, jnp.int32(1)))(
            before, flight, scene, goal
        )
        return nudged(before, judged), flight, scene, goal

    def rendering(world: env.World, carry):
        position, quaternion, scene = carry

        def one(position, quaternion, scene):
            return [
                env.view(config, take_scene(world.pool, scene), position[t], quaternion[t]) for t in range(len(steps))
            ]

        frames = jax.vmap(one)(position, quaternion, scene)
        return nudged(position, frames), quaternion, scene

    def sensing(_, carry):
        frames, memory, keys = carry
        field, memory = jax.vmap(lambda f, m, k: events.events(config.events, m, f, config.events.frame_times_s, k))(
            frames, memory, keys
        )
        return nudged(frames, field), memory, keys

    def environment(world: env.World, carry):
        state, move = carry
        state, step = jax.vmap(lambda s, a: env.step(config, world, s, a))(state, move)
        return state, nudged(move, step.observation, step.reward)

    def encoding(params, field):
        return dataclasses.replace(field, count=nudged(field.count, encoder.embed(config.encoder, params, field)))

    def acting(params, carry):
        memory, keys = carry
        q = qnetwork.q_values(config.agent, params, len(env.ACTIONS), memory)
        keys = jax.vmap(lambda k: jax.random.split(k)[0])(keys)
        action = jax.vmap(lambda q, k: dqn.epsilon_greedy(q, jnp.float32(0.02), k))(q, keys)
        return nudged(memory, action), keys

    share = config.agent.batch_size // config.train.shards
    newest = jnp.int32(state.step - trainer.Plan.of(config).warmup)

    def replaying(_, carry):
        ring, keys = carry
        row = jax.tree.map(lambda leaf: leaf[:, 0], ring)
        ring = jax.vmap(replay.write, in_axes=(0, 0, None))(ring, row, newest)

        def draw(keys, _):
            keys = jax.vmap(lambda k: jax.random.split(k)[0])(keys)
            batch = jax.vmap(lambda r, k: replay.sample(config.agent, r, newest, share, k))(ring, keys)
            return keys, jax.tree.map(jnp.sum, batch)

        keys, sums = jax.lax.scan(draw, keys, length=config.agent.updates_per_step)
        return dataclasses.replace(ring, reward=nudged(ring.reward, sums)), keys

    def seeing(field, carry):
        learner, keys = carry
        keys = jax.vmap(lambda k: jax.random.split(k)[0])(keys)
        _, learner = trainer.learn_to_see(config, AXIS, learner, field, keys, state.step)
        return learner, keys

    def learning(ring, carry):
        learner, keys = carry
        keys = jax.vmap(lambda k: jax.random.split(k)[0])(keys)
        _, learner = trainer.learn_to_act(config, AXIS, learner, ring, newest, keys, state.step)
        return learner, keys

    poses = Flight(
        position=jnp.stack([seen.flight.position[:, t - 1] for t in steps], 1),
        quaternion=jnp.stack([seen.flight.quaternion[:, t - 1] for t in steps], 1),
        velocity=jnp.zeros((config.train.num_envs, 0)),
    )
    frames = jax.random.uniform(
        jax.random.key(1), (config.train.num_envs, len(steps), *seen.observation.events.count.shape[2:])
    )
    keys = jax.random.split(jax.random.key(2), config.train.num_envs)
    shard_keys = jax.random.split(jax.random.key(3), config.train.shards)
    field = seen.observation.events
    n, updates = config.drone.physics_steps, config.agent.updates_per_step
    one = (rows, (same, rows))
    row = _bytes(jax.tree.map(lambda leaf: leaf[:, 0], actors.replay))
    # A sample reads a row for each step of its history and its return.
    each = (config.agent.history + config.agent.n_step) * row // config.train.num_envs
    sampled = updates * config.agent.batch_size * each
    return [
        Part("physics", physics, world, (environments.drone, moves, goals), scans=n),
        Part("outcome", outcomes, world, (environments.drone.position, seen.flight, scenes, goals)),
        Part("rendering", rendering, world, (poses.position, poses.quaternion, scenes)),
        Part("events", sensing, None, (frames, environments.memory, keys)),
        Part(ENVIRONMENT, environment, world, (environments, moves), floor=False),
        Part("encoder", encoding, learner.encoder, field, products=True),
        Part("acting", acting, learner.q, (flat(actors.memory), keys), products=True),
        Part("replay", replaying, None, (actors.replay, shard_keys), scans=updates, moved=sampled + row),
        Part("vae_update", seeing, field, (learner, shard_keys), one, products=True, moved=_bytes(field)),
        Part(LEARNING, learning, actors.replay, (learner, shard_keys), one, updates, products=True, moved=sampled),
    ]


class Timed:
    """A part, compiled as a scan over all devices."""

    def __init__(self, part: Part, mesh: Mesh, decisions: int) -> None:
        self.part, self.decisions, self.devices = part, decisions, mesh.size
        layout = partial(jax.tree.map, lambda spec: NamedSharding(mesh, spec), is_leaf=_is_spec)
        self.inputs = tuple(_lay(x, layout(spec)) for x, spec in zip((part.stays, part.carry), part.specs, strict=True))

        def scan(stays: Any, carry: Any, turns: Array) -> Any:
            return jax.lax.fori_loop(0, turns, lambda _, c: part.body(stays, c), carry)

        specs = (*part.specs, PartitionSpec())
        spread = jax.shard_map(scan, mesh=mesh, in_specs=specs, out_specs=part.specs[1], check_vma=False)
        self.run = (
            jax.jit(spread).lower(*self.inputs, jnp.int32(1)).compile(compiler_options(mesh.devices.flat[0].platform))
        )
        self.turns = 1
        first = min(self._seconds() for _ in range(2))
        self.turns = max(1, round(TURN_SECONDS / first))

    def _seconds(self) -> float:
        began = time.perf_counter()
        jax.block_until_ready(self.run(*self.inputs, jnp.int32(self.turns)))
        return time.perf_counter() - began

    def turn(self) -> float:
        """Microseconds of one device that a decision takes."""
        return 1e6 * self._seconds() * self.devices / (self.turns * self.decisions)

    def floor(self, ceilings: dict[str, float]) -> dict[str, float]:
        """Operations and bytes of a decision, and the microseconds of one device that they take at the least.

        Operations are XLA's count before any optimisation, a transcendental as one: what is written down, of
        which a compiler may still save some, so that a part can come close to its floor. Bytes are what must
        be read and written at the least: what the part is given and what it returns, each once.
        """
        part = self.part
        if not part.floor:
            return {}
        alone = Mesh(np.asarray(jax.devices()[:1]), (AXIS,))
        once = jax.shard_map(part.body, mesh=alone, in_specs=part.specs, out_specs=part.specs[1], check_vma=False)
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), (part.stays, part.carry))
        counted: Any = jax.jit(once).lower(*shapes).cost_analysis()
        if counted is None:  # XLA counts on CPU only
            return {}
        operations = part.scans * (counted.get("flops", 0.0) + counted.get("transcendentals", 0.0)) / self.decisions
        size = 2 * _bytes(part.carry) if part.moved is None else part.moved
        rate = ceilings["product_flops" if part.products else "vector_flops"]
        floor = 1e6 * max(operations / rate, size / self.decisions / ceilings["copy_bytes"])
        return {"operations": operations, "bytes": size / self.decisions, "floor_us": floor}


def _is_spec(x: Any) -> bool:
    return isinstance(x, PartitionSpec)


def _lay(tree: Any, layout: Any) -> Any:
    """`tree` on the devices; `layout` is a prefix of it."""
    if isinstance(layout, tuple):
        return tuple(_lay(x, y) for x, y in zip(tree, layout, strict=True))
    return jax.device_put(tree, layout)


def _bytes(tree: Any) -> int:
    leaves = (
        jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x for x in jax.tree.leaves(tree)
    )
    return sum(leaf.size * leaf.dtype.itemsize for leaf in leaves)


# ------------------------------------------------------------------------------ what it is held beside


class Rollout:
    """C MuJoCo's threaded rollout: the same airframe, constraints disabled, every core, hovering thrust."""

    def __init__(self, config: Config) -> None:
        model = drone.c_model(config.drone)
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        threads, self.drones = cores(), config.train.num_envs
        data = mujoco.MjData(model)
        data.qpos[2] = 10.0
        state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self.start = np.tile(state, (self.drones, 1))
        thrust = model.body_mass[1] * -model.opt.gravity[2] / model.nu
        self.control = np.full((self.drones, ROLLOUT_STEPS, model.nu), thrust)
        self.model, self.data = model, [mujoco.MjData(model) for _ in range(threads)]
        self.pool = rollout.Rollout(nthread=threads)

    def turn(self) -> float:
        """Physics steps per second."""
        began = time.perf_counter()
        self.pool.rollout(self.model, self.data, self.start, self.control)
        return self.drones * ROLLOUT_STEPS / (time.perf_counter() - began)


def ceilings(mesh: Mesh) -> dict[str, Callable[[], float]]:
    """What one device reaches at best while all are busy: products, fused arithmetic (flop/s), copies (bytes/s)."""
    spread = NamedSharding(mesh, PartitionSpec(AXIS))
    side, length, chains, rounds = 512, 2048, 8, 32

    def product(x: Array) -> Array:
        return jax.lax.fori_loop(0, 8, lambda _, y: jnp.clip(x @ y, -1.0, 1.0), x)

    def vector(x: Array) -> Array:
        # In cache; every element goes through independent chains of multiplications and additions.
        def body(_: Any, y: Array) -> Array:
            parts = [y * (0.1 * (k + 1)) for k in range(chains)]
            for _ in range(rounds):
                parts = [part * 0.999 + 0.001 for part in parts]
            return sum(parts[1:], parts[0]) * 0.1

        return jax.lax.fori_loop(0, 256, body, x)

    def timed(function: Callable[[Array], Array], shape: tuple[int, ...], work: float) -> Callable[[], float]:
        x = jax.device_put(jnp.full((mesh.size, *shape), 0.5), spread)
        run = jax.jit(
            jax.shard_map(
                lambda x: function(x[0])[None], mesh=mesh, in_specs=PartitionSpec(AXIS), out_specs=PartitionSpec(AXIS)
            )
        )
        jax.block_until_ready(run(x))

        def turn() -> float:
            began = time.perf_counter()
            jax.block_until_ready(run(x))
            return work / (time.perf_counter() - began)

        return turn

    size = 2**24
    return {
        "product_flops": timed(product, (side, side), 8 * 2.0 * side**3),
        "vector_flops": timed(vector, (length,), 256 * 2.0 * chains * (rounds + 1) * length),
        "copy_bytes": timed(lambda x: x + 1.0, (size,), 8.0 * size),
    }


# ------------------------------------------------------------------------------------------- report


def measure(config: Config, repeats: int, parts: bool) -> dict[str, Any]:
    """Everything that `--json` holds."""
    courses = lay_courses(config)
    devices = choose_devices(config.train.devices, config.train.shards)
    mesh = Mesh(np.asarray(devices), (AXIS,))
    whole = WholeStep(config, courses.training, devices)
    # A copy: the next chunk is given the state itself.
    host = jax.tree.map(lambda x: jax.device_put(x, devices[0]).copy(), whole.state)
    timed = (
        [Timed(part, mesh, config.train.num_envs) for part in parts_of(config, courses.training, host)] if parts else []
    )
    limits = ceilings(mesh) if parts else {}
    c_mujoco = Rollout(config)

    turns: dict[str, list[float]] = {}
    for _ in range(repeats):  # in turns, so that a slow minute hits all alike
        turns.setdefault("whole", []).append(whole.turn())
        turns.setdefault("c_mujoco_rollout", []).append(c_mujoco.turn())
        for name, turn in limits.items():
            turns.setdefault(name, []).append(turn())
        for part in timed:
            turns.setdefault(part.part.name, []).append(part.turn())
    middle = {name: statistics.median(values) for name, values in turns.items()}

    rate, physics = middle["whole"], config.drone.physics_steps
    ratios = [physics * a / b for a, b in zip(turns["whole"], turns["c_mujoco_rollout"], strict=True)]
    rows: list[dict[str, Any]] = [
        {
            "name": "whole_training_step",
            "decisions_per_second": rate,
            "physics_steps_per_second": physics * rate,
            "us_per_decision": 1e6 * len(devices) / rate,
            "over_c_mujoco_rollout": statistics.median(ratios),
        },
        {"name": "c_mujoco_rollout", "physics_steps_per_second": middle["c_mujoco_rollout"], "threads": cores()},
    ]
    for part in timed:
        us = middle[part.part.name]
        floor = part.floor(middle)
        beyond = {"over_floor": us / floor["floor_us"]} if floor else {}
        rows.append({"name": part.part.name, "us_per_decision": us, **floor, **beyond})
    if ENVIRONMENT in middle:
        inside = sum(middle[name] for name in ("physics", "outcome", "rendering", "events"))
        rows.append({"name": "resets_and_rest_of_environment", "us_per_decision": middle[ENVIRONMENT] - inside})
    rows += [{"name": name, "per_device": middle[name]} for name in limits]
    return {
        "workload": {**workload(config, courses.scene), "world": config.world.name},
        "device": processor() if devices[0].platform == "cpu" else devices[0].device_kind,
        "devices": [str(device) for device in devices],
        "versions": versions(),
        "decisions_per_second": rate,
        "compile_seconds": whole.compile_seconds,
        "repeats": repeats,
        "turns": turns,
        "rows": rows,
    }


def table(report: dict[str, Any]) -> str:
    """The figures for people, in Markdown."""
    rows = {row["name"]: row for row in report["rows"]}
    whole, rollout_row = rows["whole_training_step"], rows["c_mujoco_rollout"]
    stated = report["workload"]
    lines = [
        f"{report['device']}, {len(report['devices'])} devices, {stated['num_envs']} environments, "
        f"{stated['replayed_samples_per_decision']:g} replayed and {stated['vae_samples_per_decision']:g} VAE samples "
        f"per decision; medians of {report['repeats']}",
        "",
        "| what | measured |",
        "| --- | ---: |",
        f"| whole training step | {whole['decisions_per_second']:,.0f} decisions/s |",
        f"| 500 000 decisions | {5e5 / whole['decisions_per_second']:.1f} s |",
        f"| physics steps inside it | {whole['physics_steps_per_second']:,.0f} /s |",
        f"| C MuJoCo rollout, {rollout_row['threads']} threads | {rollout_row['physics_steps_per_second']:,.0f} /s |",
        f"| ratio of the two | {whole['over_c_mujoco_rollout']:.3f} |",
        f"| compiling the chunk | {report['compile_seconds']:.1f} s |",
    ]
    parts = [row for row in report["rows"] if "us_per_decision" in row]
    if len(parts) > 1:
        lines += [
            "",
            "| part | µs of one device a decision | floor, µs | times the floor |",
            "| --- | ---: | ---: | ---: |",
        ]
        for row in parts:
            floor = f"{row['floor_us']:.2f} | {row['over_floor']:.1f}" if "floor_us" in row else " | "
            lines.append(f"| {row['name'].replace('_', ' ')} | {row['us_per_decision']:.1f} | {floor} |")
        lines += [
            "",
            "One device at best, with all of them busy: "
            + ", ".join(
                f"{rows[name]['per_device'] / 1e9:.1f} {unit}"
                for name, unit in (
                    ("product_flops", "Gflop/s in matrix products"),
                    ("vector_flops", "Gflop/s in fused loops"),
                    ("copy_bytes", "GB/s copied"),
                )
            )
            + ".",
        ]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code 0 when all was measured, 2 for bad input."""
    use_cpu_devices()
    try:
        args, config = parse(argv)
        report = measure(config, 1 if args.quick else args.repeats, not args.whole_only)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    print(table(report))
    if args.json is not None:
        write_whole(args.json, json.dumps(plain(report), indent=1, allow_nan=False) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
