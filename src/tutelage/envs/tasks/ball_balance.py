"""BallBalance: a tray on three legs catches a ball and keeps it still in the middle; violation: the ball fell off.

The ball balancing of implicit interactive fleet learning (section 6.5 of the dissertation), on our own model.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array, Frame, MujocoTask

SPEED = 3.0
"""How fast an action of 1 stretches a knee, rad/s."""
HIPS, RISE = 0.3, 0.18
"""Distance of the hips from the tray's middle, m; how far a leg lifts its hip as its knee opens, m/rad, near rest."""
BEARINGS = np.radians([0.0, 120.0, 240.0])
"""Where the legs stand around the middle."""
SURFACE = 0.39
"""Height of the tray's surface at rest, m."""
BALL = 0.08
"""Radius of the ball, m."""
LOST = 0.25
"""A ball whose middle is lower than this fell off, m."""

_KNEES, _KNEE_SPEEDS, _BALL, _BALL_SPEED = [8, 10, 12], [7, 9, 11], slice(13, 16), slice(12, 15)
_LOADS, _TORQUES = [2, 5, 8], slice(9, 18)


class BallBalance(MujocoTask):
    """24 observations, 3 actions.

    Observations: angle (3, rad) and speed (3, rad/s) of the knees, position of the ball (3, m), from its place in the middle
    of a tray at rest, and its velocity (3, m/s); in each knee the force along the lower leg (3, N) and the torque (9, N m).

    Actions: how fast each knee is to open. Reward: 1 / ((1 + distance) (1 + speed)) of the ball, in m and m/s: 1 for one
    that lies still in the middle.
    """

    name, xml, frame_skip = "BallBalance", "ball_balance.xml", 4
    assets = Path(__file__).parent / "assets"
    fields = ("qpos", "qvel", "sensordata")
    push_body, camera = "ball", "fixed"
    horizon = 500
    disturbance = "extreme"
    expert = "tutelage.envs.experts.ball_balance:Balancer"
    action_low, action_high = (-np.ones(3, dtype=np.float32), np.ones(3, dtype=np.float32))
    summary = "a tray on three legs keeps a ball in its middle; violation: the ball fell off"

    def control(self, frame: Frame, actions: Array) -> Array:
        return SPEED * actions

    def observe(self, frame: Frame) -> Array:
        qpos, qvel, sensed = frame["qpos"], frame["qvel"], frame["sensordata"]
        ball, speed = _ball(frame)
        return np.concatenate(
            [qpos[:, _KNEES], qvel[:, _KNEE_SPEEDS], ball, speed, sensed[:, _LOADS], sensed[:, _TORQUES]], axis=1
        )

    def forward(self, frame: Frame, body_mass: Array) -> Array:
        """Nothing travels."""
        return np.zeros(len(body_mass))

    def reward(self, frame: Frame, velocity: Array, actions: Array) -> Array:
        ball, speed = _ball(frame)
        lies = ~self.violation(frame)
        return lies / ((1 + np.linalg.norm(ball, axis=1)) * (1 + np.linalg.norm(speed, axis=1)))  # type: ignore[no-any-return]

    def violation(self, frame: Frame) -> NDArray[np.bool_]:
        return np.asarray(frame["qpos"][:, _BALL][:, 2] < LOST)

    def initial(self, rng: np.random.Generator, n: int, qpos0: Array, qvel0: Array) -> tuple[Array, Array]:
        qpos, qvel = np.tile(qpos0, (n, 1)), np.tile(qvel0, (n, 1))
        # The ball falls onto the tray, on its way inwards like one that was tossed there.
        far, bearing = 0.35 * np.sqrt(rng.random(n)), rng.uniform(0, 2 * np.pi, n)
        place = np.stack([far * np.cos(bearing), far * np.sin(bearing)], axis=1)
        qpos[:, _BALL] = np.concatenate([place, SURFACE + BALL + rng.uniform(0.05, 0.3, (n, 1))], axis=1)
        qvel[:, _BALL_SPEED][:, :2] = -rng.uniform(0.0, 2.0, (n, 1)) * place + rng.uniform(-0.2, 0.2, (n, 2))
        return qpos, qvel


def _ball(frame: Frame) -> tuple[Array, Array]:
    """Where the ball is, from its place at rest in the middle, and how fast it goes, (N, 3) each."""
    return frame["qpos"][:, _BALL] - [0.0, 0.0, SURFACE + BALL], frame["qvel"][:, _BALL_SPEED]
