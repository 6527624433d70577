"""The page of runs in headless Chromium: it draws, plays, fits a phone, and asks for nothing from the network.

Needs the extra `browser` and a Chromium; CHROMIUM names its program.
"""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from edqn_jax.cli import main
from edqn_jax.config import WorldConfig
from edqn_jax.config.loading import to_yaml
from edqn_jax.learn.policy import fresh_policy
from edqn_jax.runs.checkpoints.params import save_params
from edqn_jax.sim.scene.mjcf import write_scene
from tests.support.box_flight import SMALL, world_with_a_box
from tests.support.policies import always

PHONE = {"width": 390, "height": 844}
DESK = {"width": 1360, "height": 900}
HOSTILE = "<img src=x onerror=document.title='broken'>"


def write_run(folder: Path, move: tuple[int, int, int], seed: int) -> None:
    """Writes a run of a policy that always takes the same move, with metrics and episodes."""
    folder.mkdir()
    world = folder.parent / "box.xml"
    write_scene(world_with_a_box(), world)
    train = dataclasses.replace(SMALL.train, validation_missions=4, seed=seed)
    config = dataclasses.replace(SMALL, world=WorldConfig(name=str(world)), train=train)
    (folder / "config.yaml").write_text(to_yaml(config))
    save_params(folder / "checkpoints", dataclasses.replace(fresh_policy(SMALL), q=always(move).q))
    rows = [{"decisions": 100 * k, "validation_success": k / 10} for k in range(1, 9)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    episodes = "".join(f"{10 * k},{k},{k % 9},{'goal' if k % 3 else 'collision'}\n" for k in range(80))
    (folder / "episodes.csv").write_text("step,return,length,outcome\n" + episodes)


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    write_run(folder / "ahead", (1, 0, 0), 0)
    write_run(folder / HOSTILE.replace("/", ""), (0, 1, 0), 1)
    file = folder / "page.html"
    assert main(["report", str(folder / "ahead"), str(folder / HOSTILE), "--out", str(file)]) == 0
    assert file.stat().st_size < 15e6
    return file


class Opened:
    """A page that is open, what it logged and what it asked for."""

    def __init__(self, browser: Any, file: Path, size: dict[str, int], first: str = "") -> None:
        self.said: list[str] = []
        self.asked: list[str] = []
        self.page = browser.new_page(viewport=size)
        self.page.on("console", lambda said: self.said.append(f"{said.type}: {said.text}"))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.add_init_script(first)
        self.page.goto(file.as_uri())
        self.until("document.querySelectorAll('#panels canvas').length === 4")
        self.page.wait_for_timeout(500)

    def until(self, condition: str) -> None:
        """Waits until a condition holds, 20 s at most; the page's own policy forbids Playwright's way to wait."""
        for _ in range(200):
            if self.page.evaluate(condition):
                return
            self.page.wait_for_timeout(100)
        raise AssertionError(f"it never came to {condition}")

    def pixels(self, selector: str) -> np.ndarray:
        """Returns the picture of an element, [H, W, 3]."""
        return np.asarray(Image.open(io.BytesIO(self.page.locator(selector).first.screenshot())).convert("RGB"))

    def seek(self, seconds: float) -> None:
        self.page.evaluate(
            "t => { const bar = document.getElementById('time'); bar.value = t;"
            " bar.dispatchEvent(new Event('input')); }",
            seconds,
        )
        self.page.wait_for_timeout(200)

    def number(self, expression: str) -> float:
        return float(self.page.evaluate(expression))


@pytest.fixture(params=[DESK, PHONE], ids=["desk", "phone"])
def opened(request: pytest.FixtureRequest, browser: Any, page_file: Path) -> Iterator[Opened]:
    there = Opened(browser, page_file, request.param)
    yield there
    there.page.close()


def test_it_draws_the_world_and_what_the_drone_saw(opened: Opened) -> None:
    colours = np.unique(opened.pixels("#canvas").reshape(-1, 3), axis=0)
    assert len(colours) > 50  # shaded solids, ground, lines; a blank canvas has one
    for number in range(4):
        ink = opened.page.evaluate(
            "n => { const c = document.querySelectorAll('#panels canvas')[n];"
            " return Array.from(c.getContext('2d').getImageData(0, 0, c.width, c.height).data); }",
            number,
        )
        assert min(ink[3::4]) == 255, number  # every pixel is painted


def test_it_draws_where_the_browser_names_no_language(browser: Any, page_file: Path) -> None:
    """As Chromium does in a POSIX locale."""
    named = "Object.defineProperty(navigator, 'language', { value: 'en-US@posix', configurable: true })"
    there = Opened(browser, page_file, DESK, named)
    assert there.said == [] and there.page.evaluate("document.querySelectorAll('.uplot canvas').length") > 0
    there.page.close()


def test_it_opens_where_most_is_seen_and_plays_from_the_start(opened: Opened) -> None:
    data = json.loads(opened.page.evaluate("document.getElementById('data').textContent"))
    flight = data["runs"][0]["flights"][0]
    shown = opened.number("+document.getElementById('time').value")
    assert shown == pytest.approx((flight["pictures"]["busiest"] + 1) * flight["decision_s"], abs=0.01)
    opened.page.click("#play")
    assert opened.number("+document.getElementById('time').value") < shown


def test_time_advances_the_flight_and_the_panels_while_it_plays(opened: Opened) -> None:
    panel = "document.querySelectorAll('#panels canvas')[0].toDataURL()"
    before, seen = opened.pixels("#canvas"), opened.page.evaluate(panel)
    opened.page.select_option("#speed", "4")
    opened.page.click("#play")
    opened.until("+document.getElementById('time').value > 1")
    assert opened.page.evaluate(panel) != seen
    assert not np.array_equal(opened.pixels("#canvas"), before)


def test_a_flight_ends_with_its_outcome(opened: Opened) -> None:
    opened.seek(1e6)
    assert opened.page.inner_text("#ending") == "collision"
    assert opened.number("+document.getElementById('time').value") == pytest.approx(
        opened.number("+document.getElementById('time').max"), abs=1e-6
    )


@pytest.mark.parametrize("mode", ["follow", "eye", "map"])
def test_the_view_changes_with_its_button(mode: str, opened: Opened) -> None:
    before = opened.pixels("#canvas")
    opened.page.click(f"button[data-view={mode}]")
    opened.page.wait_for_timeout(300)
    assert not np.array_equal(opened.pixels("#canvas"), before)


def test_dragging_turns_the_world(opened: Opened) -> None:
    before = opened.pixels("#canvas")
    box = opened.page.locator("#canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    opened.page.mouse.move(x, y)
    opened.page.mouse.down()
    opened.page.mouse.move(x + 80, y + 10, steps=4)
    opened.page.mouse.up()
    opened.page.wait_for_timeout(200)
    assert not np.array_equal(opened.pixels("#canvas"), before)


def test_another_run_and_flight_can_be_chosen(opened: Opened) -> None:
    opened.page.select_option("#run", "1")
    opened.page.click("#next")
    opened.page.wait_for_timeout(300)
    assert opened.page.input_value("#run") == "1" and opened.page.input_value("#flight") == "1"


def test_curves_of_both_runs_are_drawn(opened: Opened) -> None:
    assert opened.page.locator("#curves canvas").count() == 2
    assert opened.page.locator("#curves .u-series").count() >= 6


def test_it_is_no_wider_than_the_screen(opened: Opened) -> None:
    assert opened.number("document.documentElement.scrollWidth - innerWidth") <= 0


def test_it_logs_nothing_and_asks_for_nothing(opened: Opened, page_file: Path) -> None:
    for mode in ("follow", "eye", "map", "orbit"):
        opened.page.click(f"button[data-view={mode}]")
    opened.page.click("#play")
    opened.page.wait_for_timeout(500)
    assert opened.said == []
    assert [url for url in opened.asked if not url.startswith("data:")] == [page_file.as_uri()]


def test_the_name_of_a_folder_is_text(opened: Opened) -> None:
    assert HOSTILE in opened.page.inner_text("table >> nth=0") and opened.page.locator("img").count() == 0
    assert "broken" not in opened.page.title()


def test_flights_of_one_run_have_a_colour_for_each_ending_and_its_name_beside(
    browser: Any, page_file: Path, tmp_path: Path
) -> None:
    file = tmp_path / "one.html"
    assert main(["report", str(page_file.parent / "ahead"), "--out", str(file)]) == 0
    there = Opened(browser, file, DESK)
    options = there.page.evaluate("[...document.querySelectorAll('#flight option')].map((each) => each.textContent)")
    others = {option.partition(": ")[2].partition(",")[0] for option in options[1:]}
    named = there.page.evaluate("[...document.querySelectorAll('#colours span')].map((each) => each.textContent)")
    assert others and {name.strip(" ●") for name in named} == others
    there.page.locator("#others").uncheck()
    assert there.page.evaluate("document.getElementById('colours').textContent") == ""
    there.page.close()
