"""A maze in which a test is never in a hurry: no episode ends by itself, and a robot violates its constraint only where it is
driven to."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import World
from tutelage.envs.tasks.navigation import SIZE, START, Navigation

LAST = np.array(SIZE) - 1.0
"""The cell farthest along both axes."""


class Lasting(Navigation):
    """Navigation without walls, goal, wind and horizon. Violation: the robot is three cells to the left of its start, or farther.

    Only whole actions move it, which keys give and a policy that knows nothing does not.
    """

    horizon = 10**7
    disturbance = "none"

    def advance(self, state: NDArray[Any], actions: NDArray[Any], world: World) -> NDArray[Any]:
        return np.clip(super().advance(state, np.trunc(actions), world), 0.0, LAST)

    def violation(self, state: NDArray[Any]) -> NDArray[np.bool_]:
        return np.asarray(state[:, 0] <= START[0] - 3)

    def success(self, state: NDArray[Any]) -> NDArray[np.bool_]:
        return np.zeros(len(state), dtype=bool)
