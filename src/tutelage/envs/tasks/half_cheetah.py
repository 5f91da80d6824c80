"""HalfCheetah (Gymnasium v5): run forward; violation: on its back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array, Frame, MujocoTask


class HalfCheetah(MujocoTask):
    """17 observations, 6 actions. Gymnasium never ends an episode; here a torso beyond 90 degrees is a violation."""

    name, xml, frame_skip, planar = "HalfCheetah", "half_cheetah.xml", 5, True
    disturbance = "moderate"
    summary = "a planar cheetah runs forward; violation: tipped over (|pitch| > 90 degrees)"

    def observe(self, frame: Frame) -> Array:
        return np.concatenate([frame["qpos"][:, 1:], frame["qvel"]], axis=1)

    def forward(self, frame: Frame, body_mass: Array) -> Array:
        return frame["qpos"][:, 0].copy()

    def reward(self, frame: Frame, velocity: Array, actions: Array) -> Array:
        return velocity - 0.1 * np.square(actions).sum(axis=1)  # type: ignore[no-any-return]

    def violation(self, frame: Frame) -> NDArray[np.bool_]:
        return np.abs(frame["qpos"][:, 2]) > np.pi / 2

    def initial(self, rng: np.random.Generator, n: int, qpos0: Array, qvel0: Array) -> tuple[Array, Array]:
        return (
            qpos0 + rng.uniform(-0.1, 0.1, (n, qpos0.size)),
            qvel0 + 0.1 * rng.standard_normal((n, qvel0.size)),
        )
