"""The algorithmic human for ball balancing: a linear-quadratic regulator that tilts the tray."""

from __future__ import annotations

import functools

import numpy as np

from tutelage.envs.tasks.ball_balance import BEARINGS, HIPS, RISE, SPEED
from tutelage.envs.tasks.base import Array

DT = 0.02
"""Seconds of a timestep."""
ROLLING = -5 / 7 * 9.81
"""How fast a solid ball that rolls speeds up on a slope of 1, m/s^2."""
COST, EFFORT = np.diag([12.0, 3.0, 1.0]), 0.3
"""Of distance (m^2), speed (m^2/s^2) and slope; of the rate at which the slope changes (1/s^2)."""
LEVEL = 2.0
"""How fast the tray returns to its height at rest, 1/s."""


class Balancer:
    """Looks at each row alone and keeps no memory, so it can take over in any state.

    Along each horizontal axis the ball is a triple integrator: the slope's rate is commanded, the slope makes the ball speed
    up. The regulator's gains are the solution of the Riccati equation; the legs share the slope by the tray's geometry.
    """

    def act(self, obs: Array) -> Array:
        """Actions (N, 3) float32 for observations (N, 24)."""
        obs = np.asarray(obs, dtype=np.float64)
        heights, ball, speed = RISE * obs[:, :3], obs[:, 6:9], obs[:, 9:12]
        around = np.stack([np.cos(BEARINGS), np.sin(BEARINGS)])
        slope = 2 / (3 * HIPS) * heights @ around.T
        state = np.stack([ball[:, :2], speed[:, :2], slope], axis=2)
        rate = -state @ gains()
        lift = -LEVEL * heights.mean(axis=1, keepdims=True)
        knees = (lift + HIPS * rate @ around) / (RISE * SPEED)
        return np.asarray(np.clip(knees, -1.0, 1.0), dtype=np.float32)


@functools.cache
def gains() -> Array:
    """What the slope's rate is of position (m), speed (m/s) and slope, negated, (3,)."""
    a = np.array([[1, DT, ROLLING * DT**2 / 2], [0, 1, ROLLING * DT], [0, 0, 1.0]])
    b = np.array([[ROLLING * DT**3 / 6], [ROLLING * DT**2 / 2], [DT]])
    value = COST
    while True:  # the Riccati equation, until nothing changes
        gain = np.linalg.solve(EFFORT + b.T @ value @ b, b.T @ value @ a)
        nearer = COST + a.T @ value @ (a - b @ gain)
        if np.abs(nearer - value).max() < 1e-10 * np.abs(nearer).max():
            return gain[0]  # type: ignore[no-any-return]
        value = nearer
