"""Anymal: a quadruped follows velocity commands; violation: its base or a knee touches the ground.

The Anymal task of the IFL Benchmark (section 5.6 of the dissertation) on our own model, with the published dimensions of
ANYmal C.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array, Frame, MujocoTask

STANDING = np.array([0.0, 0.4, -0.8, 0.0, -0.4, 0.8] * 2)
"""Joint angles, rad, about which actions move the targets: abduction, thigh and shank of left front, left hind, right front
and right hind leg."""
ACTION, STIFFNESS = 0.5, 150.0
"""How far an action of 1 moves a target, rad, and the torque per rad from it, N m: those of the model file."""
COMMAND = np.array([1.0, 0.5, 1.0])
"""Largest command: forward and to the left, m/s, and turn to the left, rad/s."""
PERIOD = 10.0, 25.0
"""Seconds in which a command runs once through its range and back: shortest and longest."""
CONTACT = 1.0
"""A base or knee that presses on the ground harder than this has touched it, N."""
SCALE = np.concatenate(
    [np.full(3, 2.0), np.full(3, 0.25), np.ones(3), [2.0, 2.0, 0.25], np.ones(12), np.full(12, 0.05), np.ones(12)]
)
"""(48,) factors that bring observations to the order of 1."""

_QUATERNION, _JOINTS, _DIALS = slice(3, 7), slice(7, 19), slice(19, 22)
_LINEAR, _ANGULAR, _JOINT_VELOCITIES, _DIAL_SPEEDS = slice(0, 3), slice(3, 6), slice(6, 18), slice(18, 21)


class Anymal(MujocoTask):
    """48 observations, 12 actions.

    Observations, times `SCALE`: velocity of the base (3, m/s), its angular velocity (3, rad/s) and the direction of gravity
    (3), all as the base sees them; the commands (3: forward and to the left, m/s, turn, rad/s); joint angles from `STANDING`
    (12, rad) and velocities (12, rad/s); the previous actions (12).

    Actions in [-1, 1] move the position targets of the joints by up to `ACTION` from `STANDING`, 50 times a second.
    Violation: the base or a knee presses on the ground with more than `CONTACT`.
    """

    name, xml, frame_skip = "Anymal", "anymal.xml", 2
    assets = Path(__file__).parent / "assets"
    fields = ("qpos", "qvel", "qacc", "ctrl", "actuator_force", "sensordata")
    horizon = 2500
    disturbance = "moderate"
    expert = "tutelage.envs.experts.anymal:Trotter"
    summary = "a quadruped follows velocity commands; violation: base or knee touches the ground"

    def observe(self, frame: Frame) -> Array:
        q, v = frame["qpos"], frame["qvel"]
        rotation = rotations(q[:, _QUATERNION])
        parts = [
            np.einsum("nij,ni->nj", rotation, v[:, _LINEAR]),
            v[:, _ANGULAR],
            -rotation[:, 2],
            commands(frame),
            q[:, _JOINTS] - STANDING,
            v[:, _JOINT_VELOCITIES],
            frame["ctrl"],
        ]
        return np.concatenate(parts, axis=1) * SCALE  # type: ignore[no-any-return]

    def forward(self, frame: Frame, body_mass: Array) -> Array:
        return frame["qpos"][:, 0].copy()

    def reward(self, frame: Frame, velocity: Array, actions: Array) -> Array:
        """Up to 1.5 a second for following the commands, less what a smooth gait avoids (see docs/tasks.md)."""
        v = frame["qvel"]
        rotation = rotations(frame["qpos"][:, _QUATERNION])
        linear = np.einsum("nij,ni->nj", rotation, v[:, _LINEAR])
        command = commands(frame)
        along = np.exp(-4.0 * np.square(command[:, :2] - linear[:, :2]).sum(axis=1))
        turn = np.exp(-4.0 * np.square(command[:, 2] - v[:, 5]))
        cost = (
            np.square(linear[:, 2])
            + 0.02 * np.square(v[:, 3:5]).sum(axis=1)
            + 0.5 * np.square(rotation[:, 2, :2]).sum(axis=1)
            + 1e-5 * np.square(frame["actuator_force"]).sum(axis=1)
            + 2.5e-8 * np.square(frame["qacc"][:, _JOINT_VELOCITIES]).sum(axis=1)
        )
        return 0.02 * (along + 0.5 * turn - np.minimum(cost, 1.0))  # type: ignore[no-any-return]

    def violation(self, frame: Frame) -> NDArray[np.bool_]:
        return np.asarray((frame["sensordata"] > CONTACT).any(axis=1))

    def initial(self, rng: np.random.Generator, n: int, qpos0: Array, qvel0: Array) -> tuple[Array, Array]:
        q, v = np.tile(qpos0, (n, 1)), np.tile(qvel0, (n, 1))
        q[:, _JOINTS] = STANDING + rng.uniform(-0.1, 0.1, (n, 12))
        v[:, :18] += rng.uniform(-0.1, 0.1, (n, 18))
        q[:, _DIALS] = rng.uniform(-np.pi, np.pi, (n, 3))
        v[:, _DIAL_SPEEDS] = 2 * np.pi / rng.uniform(*PERIOD, (n, 3)) * rng.choice([-1.0, 1.0], (n, 3))
        return q, v


def commands(frame: Frame) -> Array:
    """Forward and sideways velocity, m/s, and turn, rad/s, that each robot is to follow, (N, 3).

    Triangle waves of the dials: all commands are equally frequent.
    """
    return COMMAND * (2 / np.pi * np.arcsin(np.sin(frame["qpos"][:, _DIALS])))


def rotations(quaternion: Array) -> Array:
    """Unit quaternions (N, 4) -> rotation matrices from base to world, (N, 3, 3)."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
