"""Walker2d (Gymnasium v5): a planar biped walks forward; violation: fallen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array, Frame, MujocoTask


class Walker2d(MujocoTask):
    """17 observations, 6 actions. Violation: torso height outside (0.8, 2.0) m or pitch outside (-1, 1) rad."""

    name, xml, frame_skip, planar = "Walker2d", "walker2d_v5.xml", 4, True
    disturbance = "moderate"
    summary = "a planar biped walks forward; violation: fallen (height or pitch of the torso)"

    def observe(self, frame: Frame) -> Array:
        return np.concatenate([frame["qpos"][:, 1:], np.clip(frame["qvel"], -10, 10)], axis=1)

    def forward(self, frame: Frame, body_mass: Array) -> Array:
        return frame["qpos"][:, 0].copy()

    def reward(self, frame: Frame, velocity: Array, actions: Array) -> Array:
        return velocity + ~self.violation(frame) - 1e-3 * np.square(actions).sum(axis=1)  # type: ignore[no-any-return]

    def violation(self, frame: Frame) -> NDArray[np.bool_]:
        z, pitch = frame["qpos"][:, 1], frame["qpos"][:, 2]
        return ~((z > 0.8) & (z < 2.0) & (np.abs(pitch) < 1.0))

    def initial(self, rng: np.random.Generator, n: int, qpos0: Array, qvel0: Array) -> tuple[Array, Array]:
        return (
            qpos0 + rng.uniform(-5e-3, 5e-3, (n, qpos0.size)),
            qvel0 + rng.uniform(-5e-3, 5e-3, (n, qvel0.size)),
        )
