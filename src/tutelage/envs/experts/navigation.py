"""The algorithmic humans for navigation: two programs that know the maze, and differ in which way they take at the fork."""

from __future__ import annotations

import numpy as np

from tutelage.envs.tasks.base import Array
from tutelage.envs.tasks.navigation import GOAL, MIDDLE, OBSTACLE, OPEN
from tutelage.policies.kinds import Kinds

_LANE = (OPEN[1][1][1] + OBSTACLE[1][1]) // 2 - MIDDLE
"""From the middle of the maze to the middle of a way around the obstacle, in y."""
_FORK, _OBSTACLE, _BEHIND = float(OPEN[1][0][0]), float(OBSTACLE[0][0]), float(OBSTACLE[1][0]) + 1.0
"""The x at which the fork opens, at which the obstacle begins, and at which it lies behind."""


class Navigator:
    """Looks at each row alone and keeps no memory, so it can take over in any state.

    Before the obstacle it takes its own way, beside it the way on which the robot is already, and behind it the middle of
    the corridor, back to which it steers against the wind.

    Args:
        side: 1 to go up (+y) at the fork, -1 to go down.
    """

    def __init__(self, side: int) -> None:
        self.side = side

    def act(self, obs: Array) -> Array:
        """Actions (N, 2) float32 for observations (N, 2)."""
        x, y = np.asarray(obs, dtype=np.float64).T
        own = MIDDLE + self.side * _LANE
        taken = MIDDLE + np.where(y >= MIDDLE, _LANE, -_LANE)
        before = x < _OBSTACLE
        stage = [
            x < _FORK,
            before & (np.abs(y - own) > 3.0),
            before,
            x < _BEHIND,
            (x < _BEHIND + 9.0) & (np.abs(y - MIDDLE) > 2.0),
        ]
        to_x = np.select(stage, [_FORK + 4.0, _FORK + 4.0, _BEHIND + 4.0, _BEHIND + 4.0, _BEHIND + 4.0], GOAL[0])
        to_y = np.select(stage, [MIDDLE, own, own, taken, MIDDLE], MIDDLE)
        along, across = np.clip(to_x - x, -1.0, 1.0), np.clip(to_y - y, -1.0, 1.0)
        return np.stack([along, across], axis=1).astype(np.float32)


def upward() -> Navigator:
    """A human who goes up at the fork."""
    return Navigator(1)


def downward() -> Navigator:
    """A human who goes down at the fork."""
    return Navigator(-1)


def team() -> Kinds:
    """As many of one kind as of the other."""
    return Kinds([upward(), downward()])
