"""The algorithmic human for peg insertion: a program that looks at the robot's state and knows what comes next."""

from __future__ import annotations

import numpy as np

from tutelage.envs.experts.inserter import Inserter, Scene
from tutelage.envs.tasks import arm, peg_insertion
from tutelage.envs.tasks.base import Array


class PegInserter(Inserter):
    """See `Inserter`; reads observations (N, 41)."""

    peg, peg_height = peg_insertion.PEG, peg_insertion.PEG_HEIGHT
    handle_at, handle_width = peg_insertion.GRIP, peg_insertion.THICKNESS
    lowest = float(arm.LOW[2])
    opened, spread, free = peg_insertion.OPEN, 0.046, 0.04
    step, twist = peg_insertion.STEP, peg_insertion.TWIST
    largest_yaw = arm.TURN

    def look(self, obs: Array) -> Scene:
        """What observations (N, 41) show."""
        return Scene(
            grip=obs[:, 18:21],
            yaw=np.arctan2(obs[:, 22], obs[:, 21]),
            finger=obs[:, 23],
            ring=obs[:, 25:28],
            handle=obs[:, 28:31],
            axis=obs[:, 31:34],
        )
