"""Interventions as films: what the robot was like before, during and after, to be looked at again.

What is kept are states, not pictures: they are small, cost the loop a copy, and are drawn in any size when somebody looks.
Robots with cameras of their own are kept as JPEG pictures, a few a second.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tutelage.console.frames import Frames
from tutelage.console.states import Frame
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step

if TYPE_CHECKING:
    from tutelage.console.engine import Engine


class Replay:
    """To be filled."""

    def __init__(self, engine: Engine, frames: Frames) -> None:
        pass

    def start(self) -> None:
        pass

    def close(self) -> None:
        pass

    def on_step(self, loop: Loop, step: Step) -> None:
        pass

    def episodes(self, limit: int) -> list[dict[str, Any]]:
        return []

    def episode(self, id: int) -> dict[str, Any] | None:
        return None

    def picture(self, id: int, frame: int, width: int, height: int) -> Frame | None:
        return None
