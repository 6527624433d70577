"""The picture of `edqn check` shows the way, its tightest place, and what is nearest there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from edqn_jax.planning.widest import find_widest_way
from edqn_jax.report.style import OUTCOME_COLOURS
from edqn_jax.report.worlds.check_map import TIGHT_COLOUR, plot_check
from edqn_jax.sim.scene.scene import Shape
from tests.support.small_worlds import RADIUS, box, small_world


def drawn(folder: Path, *shapes: Shape, flies: bool = True) -> Figure:
    scene = small_world(*shapes).scene
    way = find_widest_way(scene, RADIUS)
    return plot_check(scene, way, RADIUS, "a $world_$", "a $text_$", folder / "map.png", flies=flies)


def circles(figure: Figure, axes: int) -> list[tuple[float, float, float]]:
    found = [patch for patch in figure.axes[axes].patches if isinstance(patch, Circle)]
    places = [np.asarray(patch.get_center()) for patch in found]
    return [(place[0], place[1], patch.get_radius()) for place, patch in zip(places, found, strict=True)]


def test_the_tightest_place_is_marked_on_the_map_and_measured_in_a_level_section(tmp_path: Path) -> None:
    figure = drawn(tmp_path, box((5.9, 0, 0), (6.1, 5.2, 6)), box((5.9, 6.6, 0), (6.1, 12, 6)))
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    above, section, profile = figure.axes
    assert [text.get_text() for text in above.texts if text.get_color() == TIGHT_COLOUR] == ["tightest: shown right"]
    assert section.get_title("left") == "tightest: 0.70 m, 1.9 body radii"
    assert "section at z = 3.0 m" in section.get_xlabel()
    (x, y, room), (*_, body) = circles(figure, 1)
    assert (x, y, room, body) == pytest.approx((6.0, 5.9, 0.7, RADIUS), abs=0.05)
    dot = profile.lines[-1].get_xydata()
    assert np.asarray(dot)[0][1] == pytest.approx(0.7, abs=0.01)


def test_a_shape_without_bounds_leaves_the_map_as_large_as_the_volume(tmp_path: Path) -> None:
    figure = drawn(tmp_path, box((-1e20, -1e20, -1), (1e20, 1e20, 0.1)))
    assert np.ptp(figure.axes[0].get_xlim()) == pytest.approx(12.0, rel=0.1)


def test_what_is_near_above_and_below_is_shown_in_an_upright_section(tmp_path: Path) -> None:
    figure = drawn(tmp_path, box((5.9, 0, 0), (6.1, 12, 2.3)), box((5.9, 0, 3.7), (6.1, 12, 6)))
    assert figure.axes[1].get_ylabel() == "z, m"
    assert circles(figure, 1)[0] == pytest.approx((0.0, 3.0, 0.7), abs=0.05)


@pytest.mark.parametrize(("flies", "colour"), [(True, OUTCOME_COLOURS["goal"]), (False, TIGHT_COLOUR)])
def test_a_title_is_green_where_it_flies_and_a_world_without_a_way_is_drawn_alone(
    flies: bool, colour: str, tmp_path: Path
) -> None:
    figure = drawn(tmp_path, box((5.9, 0, 0), (6.1, 12, 6)), flies=flies)
    assert len(figure.axes) == 1
    assert figure.get_suptitle() == "a $world_$"
    assert figure._suptitle.get_color() == colour  # type: ignore[attr-defined]
