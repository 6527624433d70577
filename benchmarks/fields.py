"""Are fields right? Depth beside MuJoCo's, and distances beside trimesh's, in a world from a file.

Depth is that of pictures from free places in all directions; MuJoCo's is `mj_ray` through the same pixels of the file's
own mesh. A pixel is at a silhouette where 1 / depth bends by more than 5 % beside it.
With `--points`, distances are compared where a field says that a place is free: half of the places anywhere on
the grids, half of them within 0.3 m of a surface. Of worlds whose meshes are not convex, trimesh's are those to the
nearest point of the file's own triangles.

    python benchmarks/fields.py scenes/examples/building.xml --pictures 100 --points 100000
"""

from __future__ import annotations

from measurement.command import Parser, at_least_one, in_a_sentence

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from edqn_jax.config import CameraConfig
from edqn_jax.errors import ConfigError
from edqn_jax.evaluation.mesh_judge import triangle_solids
from edqn_jax.planning.lattice import clearances
from edqn_jax.sim.camera import camera, raycast
from edqn_jax.sim.scene.distance import shape_distances
from edqn_jax.sim.scene.mesh_field import MARGIN_M
from edqn_jax.sim.scene.mjcf import compile_model, load_world, resolve_world
from edqn_jax.sim.scene.scene import Scene
from measurement import json_report

CONFIG = CameraConfig(width=32, height=24)
ROOM_M = 0.5
"""Metres of clearance of the places from which pictures are taken."""
BESIDE_M = 0.3
"""Metres within which half of the points of `--points` lie beside a surface."""
OFF_M = 0.05
"""Metres that a distance may be off."""
SHARE = 0.05
"""Of a depth, by which one of the same pixel may differ."""


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the parsed arguments."""
    parser = Parser("fields", __doc__)
    parser.add_argument("world", nargs="?", default="scenes/examples/building.xml", help="an MJCF file")
    parser.add_argument("--pictures", type=at_least_one, default=100, help="pictures of depth (default 100)")
    parser.add_argument("--points", type=at_least_one, help="places in which distances are compared, too")
    parser.add_argument("--seed", type=int, default=0, help="of places and directions (default 0)")
    return parser.parse(argv)


def free_places(scene: Scene, count: int, rng: np.random.Generator) -> np.ndarray:
    """Returns places [count, 3], metres, with `ROOM_M` of clearance."""
    low, high = np.asarray(scene.volume)
    found = np.zeros((0, 3))
    while len(found) < count:
        tried = rng.uniform(low, high, (4 * count, 3))
        found = np.concatenate([found, tried[clearances(scene, tried) > ROOM_M]])
    return found[:count]


def depth_in_mujoco(model: mujoco.MjModel, place: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Returns the distance [H, W], metres, along directions [H, W, 3] from a place [3]; inf where nothing is met."""
    data, geom = mujoco.MjData(model), np.zeros(1, np.int32)
    mujoco.mj_forward(model, data)
    found = np.empty(directions.shape[:2])
    for row, column in np.ndindex(found.shape):
        way = directions[row, column] / np.linalg.norm(directions[row, column])
        found[row, column] = mujoco.mj_ray(model, data, place, way, None, 1, -1, geom)
    return np.where(found < 0, np.inf, found)


def at_silhouettes(depth: np.ndarray) -> np.ndarray:
    """Returns which pixels [M, H, W] have an edge beside them: on a plane closeness is linear in the picture."""
    closeness = np.pad(1 / depth, ((0, 0), (1, 1), (1, 1)), mode="reflect", reflect_type="odd")
    middle = closeness[:, 1:-1, 1:-1]
    beside = (closeness[:, 1:-1, :-2], closeness[:, 1:-1, 2:]), (closeness[:, :-2, 1:-1], closeness[:, 2:, 1:-1])
    return np.any([np.abs((one + other) / 2 - middle) > SHARE * middle for one, other in beside], axis=0)


def compare_depth(world: str, count: int, seed: int) -> dict[str, Any]:
    """Returns the shares of pixels of equal depth: of all, at silhouettes, and elsewhere."""
    path, rng = resolve_world(world), np.random.default_rng(seed)
    scene, model = load_world(path).scene, compile_model(path)
    places = free_places(scene, count, rng)
    turns = Rotation.from_rotvec(np.outer(rng.uniform(0, 2 * np.pi, count), [0, 0, 1])).as_matrix()
    see = jax.jit(jax.vmap(lambda place, turn: camera.render_depth(CONFIG, scene, place, turn)))
    ours = np.asarray(see(jnp.asarray(places, jnp.float32), jnp.asarray(turns, jnp.float32)))
    theirs = []
    for place, turn in zip(places, turns, strict=True):
        rays = raycast.camera_rays(CONFIG, jnp.asarray(turn, jnp.float32))
        parts = [np.broadcast_to(part, (CONFIG.height, CONFIG.width)) for part in (rays.dx, rays.dy, rays.dz)]
        theirs.append(depth_in_mujoco(model, place, np.stack(parts, -1).astype(np.float64)))
    theirs = np.stack(theirs)
    same, edge = np.isclose(ours, theirs, rtol=SHARE, atol=0), at_silhouettes(theirs)
    met = ~edge & np.isfinite(ours) & np.isfinite(theirs)
    return {
        "name": "depth",
        "pictures": count,
        "pixels": int(same.size),
        "share": float(same.mean()),
        "silhouettes": float(edge.mean()),
        "share_at_silhouettes": float(same[edge].mean()),
        "share_elsewhere": float(same[~edge].mean()),
        "apart_m_median_elsewhere": float(np.median(np.abs(ours[met] - theirs[met]))),
        "too_near": float(((ours < theirs) & ~same).mean()),
        "too_far": float(((ours > theirs) & ~same).mean()),
    }


def compare_distances(world: str, count: int, seed: int) -> dict[str, Any]:
    """Returns how far distances of a field, in free places, are from those to the triangles of its file.

    Raises:
        ConfigError: if a mesh of the world is convex, or there is none.
    """
    path, rng = resolve_world(world), np.random.default_rng(seed)
    scene, model = load_world(path).scene, compile_model(path)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    solids = triangle_solids(model, np.arange(model.ngeom))
    fields = scene.shapes().get("fields")
    if fields is None or not solids or len(solids) != fields.position.shape[0]:
        raise ConfigError(f"'{world}' must have meshes, none of them convex, for their distances to be compared")
    poses = {geom: (data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)) for geom in solids}
    triangles = np.concatenate([poses[geom][0] + one.triangles @ poses[geom][1].T for geom, one in solids.items()])
    find = jax.jit(jax.vmap(lambda point: jnp.min(shape_distances(scene, point)["fields"])))
    found = []
    for draw in (partial(_around, fields, rng), partial(_beside, triangles, rng)):
        free = np.zeros((0, 4))
        while len(free) < count // 2:
            points = draw(count).astype(np.float32)
            each = np.column_stack([points, find(jnp.asarray(points))])
            free = np.concatenate([free, each[each[:, 3] > 0]])
        found.append(free[: count // 2])
    points, ours = np.concatenate(found)[:, :3].astype(np.float64), np.concatenate(found)[:, 3]
    theirs = np.array(
        [
            min(one.distance((point - poses[geom][0]) @ poses[geom][1]) for geom, one in solids.items())
            for point in points
        ]
    )
    error, near = ours - theirs, theirs < BESIDE_M
    return {
        "name": "distance",
        "points": len(points),
        "share": float(np.mean(np.abs(error) <= OFF_M)),
        "too_large_m_most": float(error.max()),
        "too_large_m_most_near": float(error[near].max()),
        "too_small_m_most": float(-error.min()),
        "too_small_m_median": float(np.median(-error)),
        "slope": max(grid.slope for grid in fields.grids),
    }


def _around(fields: Any, rng: np.random.Generator, count: int) -> np.ndarray:
    """Returns places [count, 3], metres, anywhere on the grids of fields."""
    which = rng.integers(fields.position.shape[0], size=count)
    reach = np.asarray(fields.half)[which] + MARGIN_M
    away = np.einsum("nij,nj->ni", np.asarray(fields.rotation)[which], rng.uniform(-reach, reach))
    return np.asarray(fields.position)[which] + away


def _beside(triangles: np.ndarray, rng: np.random.Generator, count: int) -> np.ndarray:
    """Returns places [count, 3] up to `BESIDE_M` above triangles [F, 3, 3], metres, as many as they are large."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(normals, axis=1)
    chosen = rng.choice(len(triangles), count, p=area / area.sum())
    on = np.einsum("nk,nki->ni", rng.dirichlet(np.ones(3), count), triangles[chosen])
    return on + rng.uniform(0, BESIDE_M, (count, 1)) * normals[chosen] / area[chosen, None]


@in_a_sentence
def main(argv: Sequence[str] | None = None) -> int:
    """Returns exit code 0, or 2 for invalid input."""
    args = parse(argv)
    row = compare_depth(args.world, args.pictures, args.seed)
    print(
        f"{args.world}: depth is within {SHARE:.0%} of mj_ray in {row['share']:.1%} of {row['pixels']:,} pixels; "
        f"{row['share_at_silhouettes']:.1%} of those at silhouettes ({row['silhouettes']:.0%} of all), "
        f"{row['share_elsewhere']:.1%} elsewhere; too near {row['too_near']:.1%}, too far {row['too_far']:.1%}"
    )
    rows = [row]
    if args.points:
        rows.append(far := compare_distances(args.world, args.points, args.seed))
        print(
            f"{args.world}: of {far['points']:,} distances {far['share']:.2%} are at most {OFF_M:g} m off; too large "
            f"by at most {far['too_large_m_most']:.4f} m ({far['too_large_m_most_near']:.4f} within {BESIDE_M:g} m of "
            f"a surface), too small by at most {far['too_small_m_most']:.3f} (median {far['too_small_m_median']:.4f}); "
            f"they change by at most {far['slope']:.2f} metres a metre"
        )
    about = {"world": args.world, "seed": args.seed}
    json_report.write(args.json, {**json_report.machine(jax.devices()), **about, "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
