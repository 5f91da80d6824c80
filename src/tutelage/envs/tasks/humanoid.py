"""Humanoid (Gymnasium v5): a biped with 17 joints walks forward; violation: fallen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array, Frame, MujocoTask


class Humanoid(MujocoTask):
    """348 observations (45 of pose and velocity), 17 actions. Violation: torso height outside (1.0, 2.0) m."""

    name, xml, frame_skip = "Humanoid", "humanoid.xml", 5
    fields = ("qpos", "qvel", "cinert", "cvel", "qfrc_actuator", "cfrc_ext", "xipos", "ctrl")
    contact_forces = True
    expert_features = 45
    disturbance = "moderate"
    initial_period = 1000
    summary = "a humanoid walks forward; violation: torso below 1 m or above 2 m"

    def observe(self, frame: Frame) -> Array:
        n = len(frame["qpos"])
        return np.concatenate(
            [
                frame["qpos"][:, 2:],
                frame["qvel"],
                frame["cinert"][:, 1:].reshape(n, -1),
                frame["cvel"][:, 1:].reshape(n, -1),
                frame["qfrc_actuator"][:, 6:],
                frame["cfrc_ext"][:, 1:].reshape(n, -1),
            ],
            axis=1,
        )

    def forward(self, frame: Frame, body_mass: Array) -> Array:
        return (frame["xipos"][:, :, 0] * body_mass).sum(axis=1) / body_mass.sum(axis=1)  # type: ignore[no-any-return]

    def reward(self, frame: Frame, velocity: Array, actions: Array) -> Array:
        control = 0.1 * np.square(frame["ctrl"]).sum(axis=1)
        contact = np.minimum(5e-7 * np.square(frame["cfrc_ext"]).sum(axis=(1, 2)), 10.0)
        return 1.25 * velocity + 5.0 * ~self.violation(frame) - control - contact  # type: ignore[no-any-return]

    def violation(self, frame: Frame) -> NDArray[np.bool_]:
        z = frame["qpos"][:, 2]
        return ~((z > 1.0) & (z < 2.0))

    def initial(self, rng: np.random.Generator, n: int, qpos0: Array, qvel0: Array) -> tuple[Array, Array]:
        return (
            qpos0 + rng.uniform(-0.01, 0.01, (n, qpos0.size)),
            qvel0 + rng.uniform(-0.01, 0.01, (n, qvel0.size)),
        )
