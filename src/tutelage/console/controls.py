"""How people drive each task: what keys, sticks and the pointer mean as actions."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Axis:
    """One number of an action.

    Attributes:
        index: which one.
        label: what it does.
        low, high: its bounds as people use them.
        keys: `KeyboardEvent.code` of the key towards low and of the one towards high.
        gamepad: "axis0", "-axis1" (reversed) or "button0" where a gamepad can do it.
        toggle: whether a key press switches between low and high, as a gripper's does, and stays there.
    """

    index: int
    label: str
    low: float
    high: float
    keys: tuple[str, str]
    gamepad: str | None = None
    toggle: bool = False


@dataclass(frozen=True)
class Pointer:
    """What a click and drag on the picture means.

    Attributes:
        kind: "push": the drag is the way that something is to move; "go": the robot goes to where the drag ends.
        camera: in which picture.
        aspect: width / height of the picture for which `world` holds.
        world: (2, 3), from (x, y, 1) of a picture, 0 to 1 from the top left, to the task's coordinates.
    """

    kind: str
    camera: int
    aspect: float
    world: tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class Controls:
    """How people drive.

    Attributes:
        axes: of keyboard and gamepad.
        pointer: of the mouse, None where it means nothing.
        assist: whether the task's algorithmic human can act for the person as long as they hold a key.
        once: whether each command is one move (a push); else it holds until the next one or until it is stale.
        help: one line.
    """

    axes: tuple[Axis, ...]
    pointer: Pointer | None
    assist: bool
    once: bool
    help: str

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)
