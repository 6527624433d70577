"""What a policy meets that it was not trained with: looks, speeds, cameras."""

from __future__ import annotations

import dataclasses

from edqn_jax.config import FAMILIES, Config
from edqn_jax.sim.scene.scene import Scene

MANY_LOOKS, ONE_LOOK = "drawn", "plaid"
"""The `surface.pattern` that a policy learns any look from, and the one under which a file's world keeps its own."""


def describe_unseen(trained: Config, flown: Config, scene: Scene | None = None) -> list[str]:
    """Returns a sentence for each thing that differs from what a policy was trained with; none where nothing does.

    Args:
        trained: configuration that the policy was trained with.
        flown: that it flies with, or learns more with.
        scene: a world from a file, whose shapes may have patterns of their own; None is none.
    """
    found = []
    known, met = trained.surface.pattern, flown.surface.pattern
    if met != known and known != MANY_LOOKS:
        found.append(
            f"this policy was trained with surface.pattern {known} alone; with {met} it sees what it never learnt"
        )
    elif known == ONE_LOOK and trained.world.name in FAMILIES and scene is not None and _has_patterns(scene):
        found.append(
            f"this policy was trained with surface.pattern {known} alone; the shapes of this world have patterns of "
            "their own: it sees what it never learnt"
        )
    speed = {"speed_m_s": (trained.env.speed_m_s, flown.env.speed_m_s)}
    names = [option.name for option in dataclasses.fields(trained.camera)]
    camera = {name: (getattr(trained.camera, name), getattr(flown.camera, name)) for name in names}
    for group, options in (("env", speed), ("camera", camera)):
        changed = {name: values for name, values in options.items() if values[0] != values[1]}
        if changed:
            was = ", ".join(f"{group}.{name} {before}" for name, (before, _) in changed.items())
            now = ", ".join(str(after) for _, after in changed.values())
            found.append(f"this policy was trained with {was}, not {now}: how it flies so has not been measured")
    return found


def _has_patterns(scene: Scene) -> bool:
    """Returns whether shapes of a world have patterns that its file says."""
    return any(getattr(shapes, "surface", None) is not None for shapes in scene.shapes().values())
