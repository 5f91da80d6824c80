"""Pictures of the robots that somebody watches, drawn by one thread that never touches the physics.

At the end of a timestep the loop copies the states of the watched robots, a few numbers each; the thread draws from the
copies. Robots with cameras of their own send pictures, which are only passed on.
"""

from __future__ import annotations

import logging
import threading
import time
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tutelage.console.states import Frame
from tutelage.envs.array_fleet import ArrayFleet
from tutelage.errors import TutelageError
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step

Array = NDArray[Any]
Picture = NDArray[np.uint8]
_LOG = logging.getLogger(__name__)

WATCHED = 2.0
"""Seconds after the last question for a picture until nobody is taken to watch any more."""
LARGEST = 1920
"""Pixels of a side, at most."""


class Painter(Protocol):
    """What robots of a fleet look like."""

    def copy(self, robots: Array) -> Array:
        """The states of robots (n indices), (n, S), in the loop's thread between two steps."""
        ...

    def draw(self, state: Array, width: int, height: int) -> Picture:
        """A robot in such a state (S,), (at most height, at most width, 3) uint8; always in the same thread."""
        ...

    def close(self) -> None:
        """Free what drawing needs, in that thread."""
        ...


class ArrayPainter:
    """Robots whose task draws them from their state."""

    def __init__(self, fleet: ArrayFleet) -> None:
        self._fleet = fleet

    def copy(self, robots: Array) -> Array:
        return self._fleet.states[robots]

    def draw(self, state: Array, width: int, height: int) -> Picture:
        return np.asarray(self._fleet.task.draw(state[None], width, height)[0])

    def close(self) -> None:
        """Nothing to free."""


class MujocoPainter:
    """Robots of the MuJoCo engine: their position is copied, and drawn with simulation data of the painter's own."""

    def __init__(self, fleet: Any) -> None:
        self._fleet = fleet
        self._renderers: dict[tuple[int, int], Any] = {}
        self._data: Any = None

    def copy(self, robots: Array) -> Array:
        return np.stack([self._fleet.physics.datas[robot].qpos for robot in robots.tolist()])

    def draw(self, state: Array, width: int, height: int) -> Picture:
        import mujoco

        from tutelage.envs.rendering import Renderer

        model, task = self._fleet.physics.model, self._fleet.task
        if self._data is None:
            self._data = mujoco.MjData(model)
        if (width, height) not in self._renderers:
            if len(self._renderers) >= 4:  # somebody drags a window: contexts are precious
                self._renderers.pop(next(iter(self._renderers))).close()
            body = model.body(task.push_body).id
            self._renderers[width, height] = Renderer(model, width, height, body=body, camera=task.camera)
        self._data.qpos[:] = state
        mujoco.mj_kinematics(model, self._data)
        mujoco.mj_comPos(model, self._data)
        mujoco.mj_camlight(model, self._data)
        mujoco.mj_tendon(model, self._data)
        return self._renderers[width, height].picture(self._data)  # type: ignore[no-any-return]

    def close(self) -> None:
        for renderer in self._renderers.values():
            renderer.close()


class SeenPainter:
    """Robots that observe images: what they see is what people see."""

    def __init__(self) -> None:
        self.obs: Array | None = None

    def copy(self, robots: Array) -> Array:
        return self.obs[robots] if self.obs is not None else np.zeros((len(robots), 1, 1, 3), dtype=np.uint8)

    def draw(self, state: Array, width: int, height: int) -> Picture:
        return fitted(state, width, height)

    def close(self) -> None:
        """Nothing to free."""


class OwnPainter:
    """Simulated robots of somebody else, which draw themselves: in the loop's thread, for only there are they at rest."""

    def __init__(self, fleet: Any) -> None:
        self._fleet = fleet

    def copy(self, robots: Array) -> Array:
        return np.stack([np.asarray(self._fleet.render_robot(robot), dtype=np.uint8) for robot in robots.tolist()])

    def draw(self, state: Array, width: int, height: int) -> Picture:
        return fitted(state, width, height)

    def close(self) -> None:
        """Nothing to free."""


def fitted(picture: Picture, width: int, height: int) -> Picture:
    """A picture as large as it fits in width x height, with its shape kept."""
    high, wide = picture.shape[:2]
    scale = min(width / wide, height / high)
    w, h = max(1, int(wide * scale)), max(1, int(high * scale))
    rows, columns = (np.arange(h) / scale).astype(int), (np.arange(w) / scale).astype(int)
    return picture[np.ix_(rows.clip(max=high - 1), columns.clip(max=wide - 1))]


def painter_of(fleet: Fleet) -> Painter | None:
    """How to draw a fleet's robots; None: nobody knows."""
    if isinstance(fleet, ArrayFleet):
        return ArrayPainter(fleet)
    if hasattr(fleet, "physics"):
        return MujocoPainter(fleet)
    shape = fleet.single_observation_space.shape or ()
    if len(shape) == 3 and shape[2] == 3:
        return SeenPainter()
    return OwnPainter(fleet) if hasattr(fleet, "render_robot") and fleet.render_mode else None


class Frames:
    """The newest pictures of a fleet.

    Args:
        fleet: whose robots; not wrapped.
        hz: timesteps a second.
    """

    def __init__(self, fleet: Fleet, hz: float) -> None:
        self.painter = None if hasattr(fleet, "picture") else painter_of(fleet)
        self._fleet, self._n = fleet, fleet.num_envs
        self._changed = threading.Condition()
        self._watched: dict[tuple[int, int, int], float] = {}
        self._frames: dict[tuple[int, int, int], Frame] = {}
        self._states: dict[int, tuple[float, Array]] = {}
        self._asked: list[_Asked] = []
        self._fresh, self._closing = False, False
        self._thread = threading.Thread(target=self._run, name="pictures", daemon=True)

    def start(self) -> None:
        """Begin to draw."""
        if self.painter is not None:
            self._thread.start()

    def close(self) -> None:
        """End."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(10.0)

    def get(self, robot: int, camera: int, width: int, height: int) -> Frame | None:
        """The newest picture of a robot; asking makes it watched."""
        if not (0 <= robot < self._n and 1 <= width <= LARGEST and 1 <= height <= LARGEST and camera >= 0):
            return None
        if self.painter is None:
            if not hasattr(self._fleet, "picture"):
                return None
            found = self._fleet.picture(robot, camera)
            return None if found is None else Frame(found[0], found[1])
        if camera != 0:
            return None
        key = (robot, width, height)
        with self._changed:
            if key not in self._watched:
                self._fresh = True
                self._changed.notify_all()
            self._watched[key] = time.monotonic()
            return self._frames.get(key)

    def draw(self, state: Array, width: int, height: int, timeout: float = 10.0) -> Picture | None:
        """A picture of a state that was copied before. Waits for the thread."""
        if self.painter is None or not self._thread.is_alive():
            return None
        asked = _Asked(state, min(width, LARGEST), min(height, LARGEST))
        with self._changed:
            self._asked.append(asked)
            self._changed.notify_all()
        asked.done.wait(timeout)
        return asked.picture

    def on_step(self, loop: Loop, step: Step) -> None:
        """Copy what is watched (in the loop's thread)."""
        if self.painter is None:
            return
        if isinstance(self.painter, SeenPainter):
            self.painter.obs = loop.obs
        now = time.monotonic()
        with self._changed:
            for key in [k for k, asked in self._watched.items() if now - asked > WATCHED]:
                del self._watched[key]
                self._frames.pop(key, None)
            self._states = {}
        self.look()

    def look(self) -> None:
        """Copy what somebody began to watch since the last timestep (in the loop's thread, between two of them)."""
        if self.painter is None:
            return
        with self._changed:
            robots = sorted({robot for robot, _, _ in self._watched})
            if all(robot in self._states for robot in robots):
                return
        states, taken = self.painter.copy(np.array(robots)), time.time()
        with self._changed:
            self._states = {robot: (taken, state) for robot, state in zip(robots, states, strict=True)}
            self._fresh = True
            self._changed.notify_all()

    # -- the thread ---------------------------------------------------------------------------------------------

    def _run(self) -> None:
        assert self.painter is not None
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._fresh or self._asked or self._closing)
                if self._closing:
                    break
                wanted, states, asked = list(self._watched), self._states, self._asked
                self._fresh, self._asked = False, []
            for one in asked:
                one.picture = self._draw(one.state, one.width, one.height)
                one.done.set()
            for robot, width, height in wanted:
                if robot in states:
                    taken, state = states[robot]
                    before = self._frames.get((robot, width, height))
                    if before is None or before.time != taken:
                        picture = self._draw(state, width, height)
                        if picture is not None:
                            self._frames[robot, width, height] = Frame(taken, picture)
        self.painter.close()

    def _draw(self, state: Array, width: int, height: int) -> Picture | None:
        assert self.painter is not None
        try:
            return self.painter.draw(state, width, height)
        except TutelageError as error:
            _LOG.warning("no pictures: %s", error)
            return None


class _Asked:
    """A picture that somebody waits for."""

    def __init__(self, state: Array, width: int, height: int) -> None:
        self.state, self.width, self.height = state, width, height
        self.done = threading.Event()
        self.picture: Picture | None = None
