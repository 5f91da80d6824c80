"""How people drive each task: what keys, sticks and the pointer mean as actions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tutelage.console.states import Denied
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.policy import Policy
from tutelage.fleet.supervisor import PolicySupervisor
from tutelage.policies.kinds import kinds_of

if TYPE_CHECKING:
    from tutelage.envs.tasks.base import View

Array = NDArray[Any]
FAR = 10.0
"""How far from the middle of a view people may point, in its longer side: pictures may show more than the view."""


@dataclass(frozen=True)
class Axis:
    """One number of an action.

    Attributes:
        index: which one.
        label: what it does.
        low, high: its bounds.
        keys: `KeyboardEvent.code` of the key towards low and of the one towards high; "": none.
        gamepad: "axis0", "-axis1" (reversed), "button0/button1" (low/high) or "button7" (high), where a gamepad can do it.
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
        kind: "push": the drag is the way that something is to move, once; "go": the robot goes to where the pointer is, as
            long as it is pressed.
        camera: in which picture.
        view: which part of the task's plane such a picture shows. The page knows the picture, so it says where on the plane
            people point.
    """

    kind: str
    camera: int
    view: View


@dataclass(frozen=True)
class Controls:
    """How people drive.

    Attributes:
        axes: of keyboard and gamepad.
        pointer: of the mouse, None where it means nothing.
        assist: whether the task's algorithmic human can act for the person as long as they hold `assist_key`.
        once: whether each command is one move (a push); else it holds until the next one or until it is stale.
        help: one line.
        assist_key: `KeyboardEvent.code`.
    """

    axes: tuple[Axis, ...]
    pointer: Pointer | None = None
    assist: bool = False
    once: bool = False
    help: str = ""
    assist_key: str = "Space"

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)


class Driver:
    """Turns what people send into actions.

    Args:
        controls: how they drive.
        fleet: whose robots.
        expert: the algorithmic human, for `assist`; None: there is none.
    """

    def __init__(self, controls: Controls, fleet: Fleet, expert: Policy | None = None) -> None:
        self.controls, self._fleet = controls, fleet
        self._low, self._high = fleet.action_low, fleet.action_high
        self._kinds = [PolicySupervisor(kind, fleet) for kind in kinds_of(expert)] if expert else []

    @property
    def pushes(self) -> bool:
        """Whether a drag is one move."""
        return self.controls.pointer is not None and self.controls.pointer.kind == "push"

    def check(self, action: Sequence[float] | None) -> Array | None:
        """An action from outside: (A,) float32 within bounds.

        Raises:
            Denied: bad_command: not that many finite numbers.
        """
        if action is None:
            return None
        numbers = _numbers(action, len(self._low))
        if numbers is None:
            raise Denied("bad_command", f"a command is {len(self._low)} finite numbers")
        return np.clip(numbers, self._low, self._high).astype(np.float32)

    def check_push(self, push: Any) -> tuple[float, float, float, float] | None:
        """A drag from outside: from (x, y) to (x, y), on the task's plane.

        Raises:
            Denied: bad_command.
        """
        if push is None:
            return None
        if self.controls.pointer is None:
            raise Denied("bad_command", "the pointer means nothing at this task")
        numbers, view = _numbers(push, 4), self.controls.pointer.view
        if numbers is None:
            raise Denied("bad_command", "a push is 4 finite numbers")
        if np.abs(numbers.reshape(2, 2) - (view.x, view.y)).max() > FAR * max(view.width, view.height):
            raise Denied("bad_command", "a push begins and ends in the picture")
        x0, y0, x1, y1 = numbers.tolist()
        return x0, y0, x1, y1

    def action(self, action: Array | None, push: Sequence[float] | None, obs: Array, robot: int) -> Array | None:
        """The action (A,) of a command, where the robot shows `obs`; None: it says nothing."""
        if push is not None and self.controls.pointer is not None:
            state = self._fleet.state
            return self._pushed(self.controls.pointer, push, obs if state is None else state[robot])
        if action is not None and self.controls.once and not action.any():
            return None  # no key is pressed: a push of nothing would still be a push
        return action

    def assist(self, obs: Array, robots: Array, humans: Array) -> Array:
        """What the algorithmic human does for the persons (n,) at the robots (n,), (n, A)."""
        actions = np.full((len(robots), len(self._low)), np.nan, dtype=np.float32)
        for k, kind in enumerate(self._kinds):
            mine = humans % len(self._kinds) == k
            if mine.any():
                actions[mine] = np.clip(kind.act(obs[mine], robots[mine]), self._low, self._high)
        return actions

    def _pushed(self, pointer: Pointer, push: Sequence[float], obs: Array) -> Array | None:
        start, end = np.array(push).reshape(2, 2)
        if pointer.kind == "go":
            return np.asarray(np.clip(end - obs[:2], self._low, self._high), dtype=np.float32)
        way = end - start
        far = float(np.linalg.norm(way))
        if far < 1e-3:
            return None
        if len(self._low) == 4:  # four discrete pushes: the one that is nearest to the drag
            from tutelage.envs.tasks.block_pushing import FACES

            return np.asarray(np.where(np.arange(4) == np.argmax(FACES @ way), self._high, self._low))
        from tutelage.envs.tasks.block_pushing import STEP

        way /= STEP
        return np.asarray(way / max(1.0, float(np.abs(way).max())), dtype=np.float32)


def _numbers(values: Any, n: int) -> Array | None:
    """n finite numbers as float64 (n,), or None."""
    if not isinstance(values, Sequence | np.ndarray) or isinstance(values, str) or len(values) != n:
        return None
    if not all(isinstance(v, int | float | np.floating) and not isinstance(v, bool) and math.isfinite(v) for v in values):
        return None
    return np.array(values, dtype=np.float64)


# -- the tasks ----------------------------------------------------------------------------------------------------

_LEFT_RIGHT, _DOWN_UP = ("ArrowLeft", "ArrowRight"), ("ArrowDown", "ArrowUp")
_PAIRS = (_LEFT_RIGHT, _DOWN_UP, ("KeyA", "KeyD"), ("KeyS", "KeyW"), ("KeyQ", "KeyR"), ("KeyF", "KeyG"))
_STICKS = ("axis0", "-axis1", "axis2", "-axis3", "button6/button7", "button4/button5")


def controls_of(task: str, fleet: Fleet, assist: bool) -> Controls:
    """How people drive robots at a task: its own way where it has one, else an axis for each number of an action.

    Args:
        task: its name.
        fleet: whose robots, not wrapped. One that a function of somebody's makes says itself what its task is a kind of.
        assist: whether there is an algorithmic human.
    """
    kinds = [getattr(kind, "name", "") for kind in type(getattr(fleet, "task", None)).__mro__]
    made = next((_TASKS[name] for name in (task, *kinds) if name in _TASKS), None)
    if made is not None:
        return made(assist)
    low, high = fleet.action_low.tolist(), fleet.action_high.tolist()
    if len(low) > len(_PAIRS):
        return Controls((), assist=assist, help=f"{len(low)} joints are too many for hands: hold Space, and the expert acts")
    axes = tuple(Axis(k, f"action {k + 1}", float(low[k]), float(high[k]), _PAIRS[k], _STICKS[k]) for k in range(len(low)))
    return Controls(axes, assist=assist, help="each pair of keys is one number of the action")


def _axis(index: int, label: str, pair: int) -> Axis:
    return Axis(index, label, -1.0, 1.0, _PAIRS[pair], _STICKS[pair])


def _navigation(assist: bool) -> Controls:
    from tutelage.envs.tasks.navigation import VIEW

    axes = (_axis(0, "right", 0), _axis(1, "up", 1))
    return Controls(axes, Pointer("go", 0, VIEW), assist, help="arrows steer; or press where the robot is to go")


def _block_pushing(assist: bool) -> Controls:
    from tutelage.envs.tasks.block_pushing import VIEW

    faces = (("right", "ArrowRight", "button15"), ("up", "ArrowUp", "button12"),
             ("left", "ArrowLeft", "button14"), ("down", "ArrowDown", "button13"))  # fmt: skip
    axes = tuple(Axis(k, label, 0.0, 1.0, ("", key), pad) for k, (label, key, pad) in enumerate(faces))
    help = "arrows push the block by 3 cm; or drag on the picture"
    return Controls(axes, Pointer("push", 0, VIEW), assist, once=True, help=help)


def _obstacle_pushing(assist: bool) -> Controls:
    from tutelage.envs.tasks.block_pushing import VIEW

    axes = (_axis(0, "right", 0), _axis(1, "up", 1))
    help = "drag the way the block is to go, at most 3 cm; or arrows"
    return Controls(axes, Pointer("push", 0, VIEW), assist, once=True, help=help)


def _peg_insertion(assist: bool) -> Controls:
    axes = (
        _axis(0, "right", 0), _axis(1, "away", 1), _axis(2, "up", 3), _axis(3, "turn", 2),
        Axis(4, "gripper", -1.0, 1.0, ("", "KeyG"), "button0", toggle=True),
    )  # fmt: skip
    return Controls(axes, None, assist, help="arrows move the gripper, W and S lift and lower it, A and D turn it, G grips")


def _cable_routing(assist: bool) -> Controls:
    return Controls((_axis(0, "right", 0), _axis(1, "away", 1)), None, assist, help="arrows draw the cable around the pegs")


def _ball_balance(assist: bool) -> Controls:
    axes = (_axis(0, "right leg", 0), _axis(1, "rear left leg", 1), _axis(2, "front left leg", 3))
    return Controls(axes, None, assist, help="each pair of keys lowers and lifts one leg; Space: the expert balances")


_TASKS = {
    "Navigation": _navigation,
    "BlockPushing": _block_pushing,
    "ObstaclePushing": _obstacle_pushing,
    "PegInsertion": _peg_insertion,
    "CableRouting": _cable_routing,
    "BallBalance": _ball_balance,
}
