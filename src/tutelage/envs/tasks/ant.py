"""Ant (Gymnasium v5): a quadruped walks forward; violation: torso too low or too high, or on its back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array, Frame, MujocoTask


class Ant(MujocoTask):
    """105 observations (27 of pose and velocity, 78 contact forces), 8 actions.

    Violation: torso outside [0.2, 1.0] m, as in Gymnasium, or upside down. An ant on its back cannot get up, whoever
    drives it: it needs a hard reset like any robot that fell.
    """

    name, xml, frame_skip = "Ant", "ant.xml", 5
    fields = ("qpos", "qvel", "cfrc_ext", "xpos")
    contact_forces = True
    expert_features = 27
    disturbance = "mild"
    offline_pairs = 2000
    summary = "a quadruped walks forward; violation: torso below 0.2 m, above 1 m, or upside down"

    def observe(self, frame: Frame) -> Array:
        forces = np.clip(frame["cfrc_ext"], -1.0, 1.0)[:, 1:].reshape(len(frame["qpos"]), -1)
        return np.concatenate([frame["qpos"][:, 2:], frame["qvel"], forces], axis=1)

    def forward(self, frame: Frame, body_mass: Array) -> Array:
        return frame["xpos"][:, 1, 0].copy()

    def reward(self, frame: Frame, velocity: Array, actions: Array) -> Array:
        contact = 5e-4 * np.square(np.clip(frame["cfrc_ext"], -1.0, 1.0)).sum(axis=(1, 2))
        return velocity + self.healthy(frame) - 0.5 * np.square(actions).sum(axis=1) - contact  # type: ignore[no-any-return]

    def healthy(self, frame: Frame) -> NDArray[np.bool_]:
        """Whether each robot earns Gymnasium's reward for being healthy, (N,): it depends on the torso's height alone."""
        z = frame["qpos"][:, 2]
        return np.asarray((z >= 0.2) & (z <= 1.0))

    def violation(self, frame: Frame) -> NDArray[np.bool_]:
        w, x, y, z = frame["qpos"][:, 3:7].T
        upward = w * w + z * z - x * x - y * y  # the vertical component of the torso's own vertical axis
        return np.asarray(~(self.healthy(frame) & (upward > 0.0)))

    def initial(self, rng: np.random.Generator, n: int, qpos0: Array, qvel0: Array) -> tuple[Array, Array]:
        return (
            qpos0 + rng.uniform(-0.1, 0.1, (n, qpos0.size)),
            qvel0 + 0.1 * rng.standard_normal((n, qvel0.size)),
        )
