"""The algorithmic human for robosuite's peg insertion (`tutelage.envs.robosuite_fleet`)."""

from __future__ import annotations

import numpy as np

from tutelage.envs.experts.inserter import Inserter, Scene
from tutelage.envs.tasks.base import Array

TABLE_HEIGHT = 0.82  # m, where the world's coordinates have it


class NutInserter(Inserter):
    """See `Inserter`; reads observations (N, 51)."""

    peg, peg_height = np.array([0.23, -0.1]), 0.13
    handle_at, handle_width = 0.06, 0.03175
    above_handle, low_enough = -0.002, 0.005  # the tips of the fingers rise while they shut
    lowest = 0.012
    opened, spread, free = 0.05, 0.06, 0.045
    step, twist = 0.0125, 0.11
    largest_yaw = 1.8

    def look(self, obs: Array) -> Scene:
        """What observations (N, 51) show."""
        nut, grip = obs[:, 0:3], obs[:, 32:35]
        table = np.array([0.0, 0.0, TABLE_HEIGHT])
        forward = _axis(obs[:, 35:39], 0)
        return Scene(
            grip=grip - table,
            yaw=np.arctan2(forward[:, 1], forward[:, 0]),
            # The fingers' angle, which is nearly linear in their distance: 5.5 cm at -0.03 rad, 0.8 cm at 0.50 rad.
            finger=0.053 - 0.09 * obs[:, [39, 42]].mean(axis=1),
            ring=nut - table,
            handle=_axis(obs[:, 3:7], 0),
            axis=_axis(obs[:, 3:7], 2),
        )


def _axis(quaternion: Array, which: int) -> Array:
    """The first or last column (N, 3) of the rotation of quaternions (N, 4), x y z w."""
    x, y, z, w = quaternion.T
    if which == 0:
        return np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
