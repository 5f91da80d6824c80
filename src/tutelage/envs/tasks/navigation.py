"""Navigation: a point robot finds its way through a maze that forks; violation: it ran into a wall.

The 2-D navigation of implicit interactive fleet learning (section 6.5 of the dissertation). Lengths are in cells.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array, ArrayTask, View, World

SIZE = (100, 61)
"""Cells of the maze along x and y."""
MIDDLE = 30.0
"""The y of start, goal and both corridors' middle line."""
START, GOAL = np.array([5.0, MIDDLE]), np.array([94.0, MIDDLE])
GOAL_RADIUS = 3.0
OBSTACLE = np.array([[23, 18], [52, 42]])
"""Corners of the obstacle at the fork: its first and last cell along each axis."""
OPEN = np.array([[[2, 23], [97, 37]], [[14, 4], [60, 56]]])
"""Corners of the open rectangles: the corridor from start to goal, and the ways around the obstacle."""
WINDY = (70.0, 85.0)
"""Where along the right corridor the wind blows, in +y."""


def _walls() -> NDArray[np.bool_]:
    walls = np.ones(SIZE, dtype=bool)
    for (left, low), (right, high) in OPEN:
        walls[left : right + 1, low : high + 1] = False
    (left, low), (right, high) = OBSTACLE
    walls[left : right + 1, low : high + 1] = True
    return walls


WALLS = _walls()
"""Whether each cell (x, y) is wall, (100, 61)."""
VIEW = View((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2, *SIZE)
"""What pictures show: all cells. Beyond them all is wall."""
_DOT = 1.5
"""Radius of the robot in pictures."""
FLOOR, WALL, WIND, FINISH, ROBOT = np.array(
    [[236, 236, 230], [70, 74, 84], [206, 224, 242], [120, 190, 110], [214, 70, 50]], dtype=np.uint8
)
"""Colours."""


class Navigation(ArrayTask):
    """2 observations, 2 actions.

    Observations: the cell in which the robot is (x, y), whole numbers. Actions: how far it moves along x and y, real numbers
    of at most 1; the robot ends in the cell that is nearest to where they and the wind lead. Violation: its cell is wall.
    Goal: within 3 cells of the end of the right corridor. State: the cell.
    """

    name = "Navigation"
    horizon = 200
    dt, noise_size = 0.1, 2
    disturbance = "wind=0.75"
    offline_pairs = 11_100
    expert = "tutelage.envs.experts.navigation:team"
    action_low, action_high = -np.ones(2, dtype=np.float32), np.ones(2, dtype=np.float32)
    summary = "a point robot in a maze with a fork and, at execution, wind; violation: it ran into a wall"

    def initial(self, rng: np.random.Generator, n: int) -> Array:
        return np.tile(START, (n, 1))

    def advance(self, state: Array, actions: Array, world: World) -> Array:
        way = np.clip(actions + world.noise, -1.0, 1.0)
        way[:, 1] += world.wind * ((state[:, 0] >= WINDY[0]) & (state[:, 0] <= WINDY[1]))
        return state + np.trunc(way + np.copysign(0.5, way))  # type: ignore[no-any-return]

    def observe(self, state: Array) -> Array:
        return state.copy()

    def violation(self, state: Array) -> NDArray[np.bool_]:
        x, y = state.astype(np.intp).T
        return np.asarray(WALLS[x, y])

    def success(self, state: Array) -> NDArray[np.bool_]:
        return np.asarray(np.square(state - GOAL).sum(axis=1) <= GOAL_RADIUS**2)

    def draw(self, state: Array, width: int, height: int) -> NDArray[np.uint8]:
        x, y, maze = _maze(width, height)
        pictures = np.repeat(maze[None], len(state), axis=0)
        for picture, (robot_x, robot_y) in zip(pictures, state, strict=True):
            rows, columns = np.flatnonzero(np.abs(y - robot_y) <= _DOT), np.flatnonzero(np.abs(x - robot_x) <= _DOT)
            near = np.square(x[columns] - robot_x) + np.square(y[rows] - robot_y)[:, None] <= _DOT**2
            part = np.ix_(rows, columns)
            picture[part] = np.where(near[..., None], ROBOT, picture[part])
        return pictures


@functools.lru_cache(16)
def _maze(width: int, height: int) -> tuple[Array, Array, NDArray[np.uint8]]:
    """The x of a picture's columns, the y of its rows, and the maze without a robot, (height, width, 3)."""
    x, y = VIEW.points(width, height)
    columns, rows = (np.rint(at).clip(0, cells - 1).astype(int) for at, cells in zip((x, y), SIZE, strict=True))
    points = np.stack(np.meshgrid(x, y), axis=-1)
    floor = np.where(((points[..., 0] >= WINDY[0]) & (points[..., 0] <= WINDY[1]))[..., None], WIND, FLOOR)
    floor = np.where((np.linalg.norm(points - GOAL, axis=-1) <= GOAL_RADIUS)[..., None], FINISH, floor)
    return x, y, np.asarray(np.where(WALLS[np.ix_(columns, rows)].T[..., None], WALL, floor))
