"""Pointing in a real browser: what arrives is where on the task's plane the pointer was, whatever the shape of the picture."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from browsing import Person, chromium, person, until
from consoles import Running
from small_supervision import SmallSupervision

from tutelage.console.audit import Audit
from tutelage.console.controls import controls_of
from tutelage.console.pictures import decoded, jpeg
from tutelage.console.supervision import Frame
from tutelage.envs.registry import make_fleet
from tutelage.envs.tasks import block_pushing, navigation

SHAPES = ((320, 180), (320, 240), (240, 320))
"""Width and height of the pictures of the first robots; the last one sends its own, of 4:3, which are passed on."""
PLACES: dict[str, tuple[list[float], Any, Any]] = {
    "Navigation": ([18.0, 51.0, 94.0, 30.0], navigation.ROBOT, navigation.FINISH),
    "ObstaclePushing": ([-0.11, 0.09, 0.1, -0.07], block_pushing.BLOCK, block_pushing.GOAL),
}
"""Of each task: where the robot (or the block) and the goal are, and their colours."""


class Pictured(SmallSupervision):
    """Robots of a task that stand still, in pictures of several shapes."""

    def __init__(self, audit: Audit, task: str) -> None:
        super().__init__(audit, robots=len(SHAPES) + 1)
        fleet: Any = make_fleet(task, 1)
        self.description = replace(self.description, task=task, controls=controls_of(task, fleet, assist=False))
        x, y, *goal = PLACES[task][0]
        state = np.array([[x, y]] if task == "Navigation" else [[x, y, 0.0, *goal]])
        self.pictures = [fleet.task.draw(state, width, height)[0] for width, height in [*SHAPES, (400, 300)]]

    def frame(self, robot: int, camera: int, width: int, height: int) -> Frame | None:
        return Frame(time.time(), self.pictures[robot])

    def jpeg(self, robot: int, camera: int) -> tuple[float, bytes] | None:
        return None if robot < len(SHAPES) else (time.time(), jpeg(self.pictures[robot]))

    def pushes(self, robot: int) -> list[Any]:
        """What people pointed at, each (x0, y0, x1, y1)."""
        with self._lock:
            return [push for _, other, _, _, _, push in self.commands if push is not None and other == robot]


@pytest.fixture(scope="module", params=list(PLACES))
def work(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Person, Pictured]]:
    """Somebody at such robots."""
    with chromium() as browser:
        server = Running(tmp_path_factory.mktemp("page"), lambda audit: Pictured(audit, request.param))
        try:
            with person(browser, server.origin, "ana") as ana:
                yield ana, server.supervision
        finally:
            server.close()


def middle(somebody: Person, colour: Any) -> tuple[float, float]:
    """Where on the screen the large picture shows this colour, px."""
    box = somebody.see_picture().bounding_box()
    shot = decoded(somebody.page.screenshot(type="jpeg", quality=100)).astype(int)
    left, top, right, bottom = (
        round(side) for side in (box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"])
    )
    rows, columns = np.nonzero(np.abs(shot[top:bottom, left:right] - colour).sum(axis=2) < 60)
    assert len(rows) > 20, "it is to be seen"
    return left + float(columns.mean()) + 0.5, top + float(rows.mean()) + 0.5


@pytest.mark.parametrize("robot", range(len(SHAPES) + 1))
def test_a_drag_arrives_as_it_was_made(work: tuple[Person, Pictured], robot: int) -> None:
    ana, supervision = work
    task, pointer = supervision.description.task, supervision.description.controls.pointer
    assert pointer is not None
    (height, width), (places, *colours) = supervision.pictures[robot].shape[:2], PLACES[task]
    ana.go(f"/robot/{robot}")
    ana.see("h1", f"point-{robot}")
    ana.page.get_by_role("button", name="Take over").click()
    ana.see(".stage-mine .view-pointer")
    shape = "(({width, height}) => [width, height])(document.querySelector('.view canvas'))"
    until(lambda: ana.page.evaluate(shape) == [width, height], "the picture")
    (x0, y0), (x1, y1) = (middle(ana, colour) for colour in colours)
    ana.page.mouse.move(x0, y0)
    ana.page.mouse.down()
    ana.page.mouse.move((x0 + x1) / 2, y0, steps=3)
    ana.page.mouse.move(x1, y1, steps=3)
    ana.see(".arrow line")
    if pointer.kind == "go":  # it goes on arriving for as long as the button is down
        before = len(supervision.pushes(robot))
        until(lambda: len(supervision.pushes(robot)) > before + 2, "commands")
    ana.page.mouse.up()
    until(lambda: supervision.pushes(robot), "a command")
    pixel = max(pointer.view.width / width, pointer.view.height / height)
    assert supervision.pushes(robot)[-1] == pytest.approx(places, abs=pixel)
    ana.page.keyboard.press("g")
    ana.page.wait_for_selector(".stage-mine", state="detached")
