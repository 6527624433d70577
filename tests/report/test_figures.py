"""The figures of a run show the data that they were given."""

from __future__ import annotations

import dataclasses
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from edqn_jax.report.curves import plot_learning, plot_returns, running_mean
from edqn_jax.report.images import EVENTS, NEARNESS, error_caption, plot_reconstruction, plot_sight
from edqn_jax.report.style import OUTCOME_COLOURS
from edqn_jax.report.worlds.flights import OBLIQUE, plot_path, plot_world
from edqn_jax.report.worlds.solids import far_to_near, is_occluded, make_cutaway, solids_of
from edqn_jax.report.worlds.views import MAP, View
from edqn_jax.sim.scene.scene import (
    Scene,
    UprightBoxes,
    build_scene,
)
from tests.support.drawn_scenes import one_of_each_kind


def a_flight(steps: int = 600) -> dict[str, np.ndarray]:
    along = np.linspace(0, 1, steps)[:, None]
    points = np.array([1, 1, 3]) * (1 - along) + np.array([89, 89, 10]) * along
    velocity = np.broadcast_to([4.0, 4.0, 0.3], points.shape)
    return dict(zip(("x", "y", "z", "vx", "vy", "vz"), [*points.T, *velocity.T], strict=True))


def is_png(file: Path) -> bool:
    return file.read_bytes().startswith(b"\x89PNG") and file.stat().st_size > 5000


def texts(figure: Figure) -> str:
    legends = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return " ".join([text.get_text() for axes in figure.axes for text in axes.texts] + legends)


def test_every_shape_but_the_parked_becomes_a_solid():
    assert len(solids_of(one_of_each_kind())) == 6


def test_the_faces_of_a_solid_enclose_its_volume():
    # The divergence theorem: a third of the sum of area x distance; polygons lie inside the round shapes.
    volumes = [
        4 / 3 * 8 * 10 * 12 * 3 / 4,
        np.pi * 9 * 12,
        4 / 3 * np.pi * 64,
        8,
        np.pi * 8 + np.pi * 4 / 3,
        np.pi * 8,
    ]
    for solid, volume in zip(solids_of(one_of_each_kind()), volumes, strict=True):
        total = 0.0
        for face, normal in zip(solid.faces, solid.outward, strict=True):
            area = np.linalg.norm(np.cross(face, np.roll(face, -1, axis=0)).sum(0)) / 2
            total += area * (normal @ face[0]) / 3
        assert total == pytest.approx(volume, rel=0.02)


def test_a_solid_hides_what_is_behind_it_and_nothing_else():
    box = solids_of(one_of_each_kind())[:1]
    below_roof, above_roof, beside = [30, 30, 2], [30, 30, 12], [50, 30, 2]
    assert is_occluded(np.array([below_roof, above_roof, beside], float), box, MAP).tolist() == [
        True,
        False,
        False,
    ]
    level = View(azimuth=0.0, elevation=0.0)
    behind, in_front = [10, 30, 5], [45, 30, 5]
    assert is_occluded(np.array([behind, in_front, [10, 30, 15]], float), box, level).tolist() == [
        True,
        False,
        False,
    ]


def a_hall(*more: UprightBoxes) -> Scene:
    """Four outer walls around a box, and more."""
    walls = [((15, -0.5), (15, 0.5)), ((15, 20.5), (15, 0.5)), ((-0.5, 10), (0.5, 10)), ((30.5, 10), (0.5, 10))]
    shapes = [a_box((*at, 3), (*half, 3)) for at, half in walls]
    shapes = [*shapes, a_box((15, 10, 1), (2, 2, 1)), *more]
    return build_scene(shapes, volume=[[0, 0, 0], [30, 20, 6]], start=[2, 2, 2], goal=[28, 18, 2])


def a_box(position: tuple[float, ...], half: tuple[float, ...]) -> UprightBoxes:
    grey = np.full(3, 0.5)
    return UprightBoxes(np.asarray(position), np.asarray(half), np.float64(0), grey)  # pyright: ignore


CEILING = a_box((15, 10, 6.2), (16, 11, 0.2))
BEAM = a_box((15, 10, 5.5), (15, 1, 0.5))


def test_a_ceiling_and_the_walls_before_the_eye_are_cut_away():
    hall = a_hall(CEILING)
    oblique, above = make_cutaway(hall, OBLIQUE), make_cutaway(hall, MAP)
    assert (len(oblique.shown), len(oblique.near_walls), oblique.note) == (3, 2, "ceiling and near walls cut away")
    assert (len(above.shown), len(above.near_walls)) == (4, 0)  # the box can be flown over
    assert above.note == "ceiling cut away; open is pale"


def test_nothing_is_cut_away_in_the_open():
    assert make_cutaway(one_of_each_kind(), OBLIQUE).note == make_cutaway(one_of_each_kind(), MAP).note == ""
    assert len(make_cutaway(one_of_each_kind(), OBLIQUE).shown) == 6


def test_the_map_of_a_closed_world_shows_a_door_open():
    beside, over = a_box((10, 5, 3), (0.1, 5, 3)), a_box((10, 12, 5), (0.1, 2, 1))
    hall = a_hall(CEILING, beside, over)
    above = make_cutaway(hall, MAP)
    assert [solid.corners[:, 2].min() for solid in above.passable] == [0.0, 4.0]  # the box, and the wall above the door
    door = np.array([[10.0, 12, 2]])
    assert not is_occluded(door, above.shown, MAP)[0]
    assert is_occluded(np.array([[10.0, 5, 2]]), above.shown, MAP)[0]
    assert not make_cutaway(hall, OBLIQUE).passable


def test_the_map_of_walls_as_high_as_the_volume_shows_a_door_open_without_a_ceiling():
    beside, over = a_box((10, 5, 3), (0.1, 5, 3)), a_box((10, 12, 5), (0.1, 2, 1))
    above = make_cutaway(a_hall(beside, over), MAP)
    assert [solid.corners[:, 2].min() for solid in above.passable] == [4.0]  # over the box there is the sky
    assert not is_occluded(np.array([[10.0, 12, 2]]), above.shown, MAP)[0]
    assert above.note == "open is pale" and not make_cutaway(a_hall(beside, over), OBLIQUE).passable


def test_a_beam_is_no_ceiling():
    assert not make_cutaway(a_hall(BEAM), MAP).has_ceiling


def test_a_picture_says_what_was_cut_away(tmp_path):
    figure = plot_world(a_hall(CEILING), tmp_path / "world.png")
    assert is_png(tmp_path / "world.png")
    assert figure.axes[0].get_title(loc="left") == "ceiling and near walls cut away"


def test_a_long_wall_is_painted_between_what_is_behind_and_before_it():
    # The eye looks from the south-east; the middle of the wall is nearer to it than the box before the wall's west end.
    boxes = a_box((25, 10, 2), (25, 0.2, 2)), a_box((45, 14, 1), (1, 1, 1)), a_box((3, 7, 1), (1, 1, 1))
    scene = build_scene(boxes, volume=[[0, 0, 0], [50, 20, 6]], start=[2, 2, 2], goal=[28, 18, 2])
    wall, behind, before = solids_of(scene)
    assert far_to_near([before, wall, behind], OBLIQUE) == [behind, wall, before]


def test_a_map_has_x_to_the_right_and_y_up():
    np.testing.assert_allclose(MAP.project(np.array([[3.0, 7.0, 9.0]])), [[3.0, 7.0]], atol=1e-9)


def test_the_world_is_drawn_in_proportion_with_start_and_goal(tmp_path):
    figure = plot_world(one_of_each_kind(), tmp_path / "world.png")
    assert is_png(tmp_path / "world.png")
    assert figure.axes[0].get_aspect() == 1.0
    assert "start (1, 1, 3)" in texts(figure) and "goal (90, 90, 10)" in texts(figure)


@pytest.mark.slow
def test_the_path_is_drawn_whole_in_both_views(tmp_path):
    figure = plot_path(one_of_each_kind(), a_flight(), np.array([[1, 1, 3], [90, 90, 10.0]]), tmp_path / "path.png")
    assert is_png(tmp_path / "path.png")
    for axes in figure.axes[:2]:
        coloured = [c for c in axes.collections if isinstance(c, LineCollection) and c.get_array() is not None]
        hidden_part, seen_part = (len(line.get_segments()) for line in coloured)
        assert hidden_part + seen_part == 599
        assert hidden_part > 0
    assert "shortest path" in texts(figure)
    shortest = np.asarray(figure.axes[2].get_lines()[0].get_xydata())
    np.testing.assert_allclose(shortest, [[0, 3], [np.hypot(89 * 2**0.5, 7), 10]])
    lines = [line for line in figure.axes[2].collections if isinstance(line, LineCollection)]
    (height,) = (line for line in lines if line.get_array() is not None and len(line.get_segments()))
    np.testing.assert_allclose(height.get_segments()[-1][-1], [np.hypot(88 * 2**0.5, 7), 10])
    assert figure.axes[2].get_ylabel() == "altitude, m"


def test_a_flight_that_fails_says_how(tmp_path):
    figure = plot_path(one_of_each_kind(), a_flight(50), None, tmp_path / "path.png", outcome="collision")
    assert "collision" in texts(figure) and "shortest path" not in texts(figure)


@pytest.mark.slow
def test_a_flight_of_one_step_can_be_drawn(tmp_path):
    plot_path(one_of_each_kind(), a_flight(1), None, tmp_path / "path.png", outcome="left_volume")
    assert is_png(tmp_path / "path.png")


def test_every_episode_is_a_point_in_its_outcomes_colour(tmp_path):
    outcomes = np.array(["goal"] * 70 + ["collision"] * 20 + ["time_out"] * 9 + ["left_volume"])
    figure = plot_returns({"return": np.linspace(-100, 100, 100), "outcome": outcomes}, tmp_path / "returns.png")
    assert is_png(tmp_path / "returns.png")
    points = {c.get_gid(): c for c in figure.axes[0].collections if isinstance(c, PathCollection)}
    counts = {name: len(np.asarray(c.get_offsets())) for name, c in points.items()}
    assert counts == {"goal": 70, "collision": 20, "time_out": 9, "left_volume": 1}
    for name, collection in points.items():
        colour = np.asarray(collection.get_facecolor())[0, :3]
        np.testing.assert_allclose(colour, to_rgba(OUTCOME_COLOURS[str(name)])[:3])


def test_a_run_without_episodes_still_has_its_picture(tmp_path):
    plot_returns({"return": np.array([]), "outcome": np.array([], str)}, tmp_path / "returns.png")
    assert is_png(tmp_path / "returns.png")


def test_several_runs_are_a_line_each_in_the_panel_of_their_group(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "scripts"))
    groups = {"one": [np.arange(10.0), np.arange(3.0), np.zeros(0)], "two": [np.ones(8)], "three": [np.zeros(5)]}
    figure = import_module("returns").draw_runs(groups, 4, tmp_path / "runs.png")
    assert is_png(tmp_path / "runs.png")
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title(loc="left") for axes in shown] == list(groups)
    assert [len(axes.get_lines()) for axes in shown] == [2, 1, 1]
    long, short = (np.asarray(line.get_xydata()) for line in shown[0].get_lines())
    np.testing.assert_allclose(long[[0, -1]], [[4.0, 1.5], [10.0, 7.5]])
    np.testing.assert_allclose(short, [[3.0, 1.0]])  # fewer episodes than the window: the mean of all


def test_the_running_mean_is_the_mean_of_each_window():
    values = np.array([1.0, 2.0, 6.0, 3.0])
    np.testing.assert_allclose(running_mean(values, 2), [1.5, 4.0, 4.5])


@pytest.mark.slow
def test_learning_shows_each_metric_where_a_line_has_it(tmp_path):
    metrics = [{"decisions": 100 * i, "reconstruction_loss": 1.0 / i, "kl": 2.0} for i in range(1, 5)]
    metrics += [{"decisions": 100 * i, "q_loss": 0.1, "epsilon": 0.5, "success_rate": 0.2} for i in range(5, 9)]
    metrics += [{"decisions": 900, "validation_success": 0.75}, {"decisions": 950, "q_loss": None}]
    figure = plot_learning(metrics, tmp_path / "learning.png")
    assert is_png(tmp_path / "learning.png")
    assert [text.get_text() for text in figure.axes[0].texts] == ["75.0%"]  # the last validation
    lines = {line.get_gid(): line for axes in figure.axes for line in axes.get_lines()}
    points = {str(name): len(np.asarray(line.get_xdata())) for name, line in lines.items()}
    assert points == {
        "success_rate": 4,
        "validation_success": 1,
        "epsilon": 4,
        "q_loss": 4,
        "reconstruction_loss": 4,
        "kl": 4,
    }


def test_metrics_of_a_learner_of_ones_own_have_axes_and_what_it_lacks_has_none(tmp_path):
    many = {f"number_{i}": 1.0 for i in range(9)}
    metrics = [{"decisions": 100 * i, "phase": "training", "temperature": 1.0 / i} | many for i in range(1, 5)]
    figure = plot_learning(metrics, tmp_path / "learning.png")
    assert is_png(tmp_path / "learning.png")
    titles = [axes.get_title("left") for axes in figure.axes if axes.get_visible()]
    assert titles == ["Success", "temperature", *(f"number {i}" for i in range(5))]
    (line,) = figure.axes[1].get_lines()
    np.testing.assert_allclose(np.asarray(line.get_ydata()), [1, 1 / 2, 1 / 3, 1 / 4])


def test_the_warm_up_is_a_curve_of_its_training_steps(tmp_path):
    steps = {"decisions": [10, 20, 30], "reconstruction_loss": [9.0, 6.0, 4.0], "kl": [1.0, 2.0, 3.0]}
    metrics = [{"decisions": 40, "reconstruction_loss": 6.3, "kl": 2.0, "warm_up": steps}]
    metrics += [{"decisions": 80, "reconstruction_loss": 3.0, "kl": 3.5, "warm_up": None}]
    figure = plot_learning(metrics, tmp_path / "learning.png")
    lines = {line.get_gid(): line for axes in figure.axes for line in axes.get_lines()}
    assert list(np.asarray(lines["reconstruction_loss"].get_xdata())) == [10, 20, 30, 80]
    assert list(np.asarray(lines["kl"].get_ydata())) == [1.0, 2.0, 3.0, 3.5]
    axes = lines["kl"].axes
    assert axes is not None
    numbers = {label.get_text() for label in axes.get_yticklabels(which="both")}
    assert {"1", "10"} <= numbers and not any("$" in number for number in numbers)  # no powers of ten


def test_the_vae_has_no_line_where_it_did_not_learn(tmp_path):
    metrics = [
        {"decisions": 100 * i, "reconstruction_loss": None if 3 <= i < 6 else 1.0, "q_loss": 0.1} for i in range(9)
    ]
    metrics += [{"decisions": 900, "reconstruction_loss": None}]
    figure = plot_learning(metrics, tmp_path / "learning.png")
    (line,) = (line for axes in figure.axes for line in axes.get_lines() if line.get_gid() == "reconstruction_loss")
    assert np.isfinite(np.asarray(line.get_ydata(), float)).tolist() == [True] * 3 + [False] * 3 + [True] * 3


def test_learning_can_be_drawn_before_anything_was_learned(tmp_path):
    plot_learning([], tmp_path / "learning.png")
    assert is_png(tmp_path / "learning.png")


def test_events_stand_below_the_image_that_made_them(tmp_path):
    counts = np.zeros((3, 24, 32), np.int8)
    counts[1, 4, 5], counts[2, 6, 7] = 3, -2
    rgb = np.random.default_rng(0).random((3, 96, 128, 3))
    figure = plot_sight(rgb, rgb[:, ::4, ::4], counts, tmp_path / "events.png", times_s=[0.26, 1.3, 2.6])
    assert is_png(tmp_path / "events.png")
    drawn = [np.asarray(axes.images[0].get_array()) for axes in figure.axes if axes.images]
    np.testing.assert_allclose(drawn[1], rgb[1])
    np.testing.assert_array_equal(np.stack(drawn[6:9]), counts)
    assert [axes.get_xlabel() for axes in figure.axes[6:9]] == ["0 events", "3 events", "2 events"]


def test_reconstructions_share_the_colours_of_the_events(tmp_path):
    counts = np.zeros((2, 24, 32))
    counts[:, 3:9, 10] = 4
    figure = plot_reconstruction(counts, counts * 0.5, tmp_path / "reconstruction.png")
    assert is_png(tmp_path / "reconstruction.png")
    limits = {axes.images[0].get_clim() for axes in figure.axes[:4]}
    assert limits == {(0.0, 4.0)}
    expected = np.sqrt(6 * 2.0**2 / (24 * 32))
    assert figure.axes[2].get_xlabel() == f"RMS error {expected:.2f}"


def test_nearness_is_drawn_below_the_events_that_it_was_told_from(tmp_path):
    counts, near = np.zeros((2, 24, 32)), np.full((2, 24, 32), 0.5)
    counts[:, 3:9, 10], near[:, 3:9, 8:14] = -4, 2.0
    seen = (counts, EVENTS)
    figure = plot_reconstruction(near, near * 0.75, tmp_path / "reconstruction.png", NEARNESS, seen)
    assert is_png(tmp_path / "reconstruction.png")
    pictures = [np.asarray(axes.images[0].get_array()) for axes in figure.axes[:6]]
    for row, expected in enumerate((counts, near, near * 0.75)):
        np.testing.assert_array_equal(np.stack(pictures[2 * row : 2 * row + 2]), expected)
    assert [axes.get_ylabel() for axes in figure.axes[:6:2]] == ["events", "true nearness, blurred", "from the code"]
    bar = figure.axes[-1]
    assert bar.get_ylabel() == "distance, bright is near"
    ticks = dict(zip((text.get_text() for text in bar.get_yticklabels()), bar.get_yticks(), strict=True))
    assert ticks["4 m"] == pytest.approx(1.5)  # half of what contact has
    assert {axes.images[0].get_clim() for axes in figure.axes[2:6]} == {(0.5, 2.0)}


def test_silent_windows_can_be_drawn(tmp_path):
    silent = np.zeros((2, 24, 32), np.int32)
    plot_reconstruction(silent, silent * 1.0, tmp_path / "reconstruction.png")
    assert is_png(tmp_path / "reconstruction.png")


def test_the_caption_of_a_prediction_says_how_far_its_distance_is_off(tmp_path):
    true = np.full((2, 6, 8), 4.0)
    distances = true * np.array([1.25, 1.5])[:, None, None], true
    near = np.random.default_rng(0).random(true.shape)
    figure = plot_reconstruction(near, near, tmp_path / "reconstruction.png", NEARNESS, distances=distances)
    captions = [axes.get_xlabel() for axes in figure.axes]
    assert "distance off by 25%" in captions and "distance off by 50%" in captions
    assert error_caption(true, np.full(true.shape, np.inf)) == "nothing within 10 m"
    assert error_caption(np.full(true.shape, np.inf), true) == "predicted far away"


@pytest.mark.whole
def test_what_is_above_start_and_goal_is_cut_off_and_on_a_map_what_is_below_is_pale(roofed: Scene) -> None:
    oblique, above = make_cutaway(roofed, OBLIQUE), make_cutaway(roofed, MAP)
    assert oblique.note == "near walls cut away; cut at 4.0 m"
    assert above.note == "cut at 4.0 m, pale below 1.5 m"
    for world in (oblique, above):
        assert max(solid.corners[:, 2].max() for solid in world.hiding) <= 4.0
        assert all(np.all(np.isfinite(solid.outward)) for solid in world.hiding)
    middle = np.array([[10.0, 5.0, 2.5], [2.2, 5.0, 1.6]])
    assert list(is_occluded(middle, oblique.hiding, MAP)) == [False, True]
    floor = middle * [1, 1, 0] + [0, 0, 0.2]
    assert list(is_occluded(floor, oblique.hiding, MAP)) == [True, True]
    assert list(is_occluded(floor, above.hiding, MAP)) == [False, True]
    outside = dataclasses.replace(roofed, start=np.array([1.0, 5.0, 2.5]), goal=np.array([19.0, 5.0, 3.0]))
    assert make_cutaway(outside, MAP).cut is None
