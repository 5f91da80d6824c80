"""FrankaCubeStack: an arm puts a cube onto another one; violation: a cube fell off the table.

The cube stacking of implicit interactive fleet learning (section 6.5, appendix D.4 of the dissertation), on our own model.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks import panda
from tutelage.envs.tasks.base import Array, Frame, GoalTask

STEP, TWIST = 0.01, 0.06
"""How far an action of 1 moves the gripper along an axis of the world, m, and turns it about one, rad, in a timestep."""
LAG = 1 - np.exp(-0.2)
"""Part of the way to its command that a joint goes in a timestep of 20 ms: the servos' stiffness is 10 times their damping.

They are slow on purpose, and commanded the farther ahead: within a timestep a joint's speed then hardly changes. Stiff ones
would jerk at each command, and shake a cube out of the fingers.
"""
OPEN, SHUT = 0.04, -0.01
"""Commands of the fingers: distance from the middle, m. They stop at what is between them."""
HALF_A, HALF_B = 0.025, 0.035
"""Half of the sides of the cubes, m."""
NEAR, AWAY = 0.02, 0.04
"""A cube so near to its place on the other one, with the gripper farther away than that, is stacked, m."""
LOW, HIGH = np.array([0.2, -0.4, 0.012]), np.array([0.75, 0.4, 0.5])
"""The box in which the gripper moves, m."""
TABLE = np.array([[-0.15, -0.45], [0.95, 0.45]])
"""Corners of the table top (x, y), m. Its height is 0."""

_ARM, _FINGERS, _HAND = slice(0, 7), slice(7, 9), 8
_A, _A_TURN, _B, _B_TURN = slice(9, 12), slice(12, 16), slice(16, 19), slice(19, 23)
_ON_TOP = np.array([0.0, 0.0, HALF_A + HALF_B])


class FrankaCubeStack(GoalTask):
    """19 observations, 7 actions.

    Observations: orientation (quaternion, 4) and position (3, m) of cube A, the way from there to cube B (3, m), position
    (3, m) and orientation (quaternion, 4) of the grip, distance of both fingers from the middle (2, m).

    Actions: steps of the gripper along the world's axes, its turns about them, and above 0 "shut", else "open". Violation: a
    cube left the table. Goal: cube A lies on cube B, and the gripper is away. Reward: up to 0.1 for coming near to cube A,
    1.5 while it is lifted, up to 2 for bringing it to its place, 16 on reaching the goal.
    """

    name, xml, frame_skip = "FrankaCubeStack", "franka_cube_stack.xml", 4
    assets = Path(__file__).parent / "assets"
    fields = ("qpos", "site_xpos", "xquat", "xanchor", "xaxis")
    push_body, camera = "cube A", "fixed"
    horizon = 500
    disturbance = "severe"
    offline_pairs = 860
    expert = "tutelage.envs.experts.franka_cube_stack:team"
    action_low, action_high = (-np.ones(7, dtype=np.float32), np.ones(7, dtype=np.float32))
    summary = "an arm puts a cube onto another one; violation: a cube left the table"

    def control(self, frame: Frame, actions: Array) -> Array:
        joints, place = frame["qpos"][:, _ARM], frame["site_xpos"][:, 0]
        # From where the gripper is, not from where it was told to be: what is pressed against the table does not wind up.
        step = np.clip(place + STEP * actions[:, :3], LOW, HIGH) - place
        move = np.concatenate([step, TWIST * actions[:, 3:6]], axis=1)
        change = panda.turn(joints, place, frame["xanchor"][:, _ARM], frame["xaxis"][:, _ARM], move)
        fingers = np.where(actions[:, 6] > 0, SHUT, OPEN)
        return np.concatenate([np.clip(joints + change / LAG, *panda.RANGE), fingers[:, None]], axis=1)

    def observe(self, frame: Frame) -> Array:
        qpos = frame["qpos"]
        return np.concatenate(
            [
                _one_of_two(qpos[:, _A_TURN], 0),
                qpos[:, _A],
                qpos[:, _B] - qpos[:, _A],
                frame["site_xpos"][:, 0],
                _one_of_two(frame["xquat"][:, _HAND], 1),
                qpos[:, _FINGERS],
            ],
            axis=1,
        )

    def reward(self, frame: Frame, velocity: Array, actions: Array) -> Array:
        cube = frame["qpos"][:, _A]
        lifted = cube[:, 2] > HALF_A + 0.04
        align = lifted * (1 - np.tanh(10 * np.linalg.norm(self.offset(frame), axis=1)))
        reach = 1 - np.tanh(10 * np.linalg.norm(frame["site_xpos"][:, 0] - cube, axis=1))
        return np.where(self.success(frame), 16.0, 0.1 * np.maximum(reach, align) + 1.5 * lifted + 2.0 * align)

    def success(self, frame: Frame) -> NDArray[np.bool_]:
        offset = self.offset(frame)
        away = np.linalg.norm(frame["site_xpos"][:, 0] - frame["qpos"][:, _A], axis=1) > AWAY
        return np.asarray((np.linalg.norm(offset[:, :2], axis=1) < NEAR) & (np.abs(offset[:, 2]) < NEAR / 4) & away)

    def offset(self, frame: Frame) -> Array:
        """From where cube A is to be, on top of cube B, to where it is, (N, 3), m."""
        return frame["qpos"][:, _A] - frame["qpos"][:, _B] - _ON_TOP  # type: ignore[no-any-return]

    def violation(self, frame: Frame) -> NDArray[np.bool_]:
        cubes = np.stack([frame["qpos"][:, _A], frame["qpos"][:, _B]], axis=1)
        inside = (cubes[..., :2] > TABLE[0]) & (cubes[..., :2] < TABLE[1])
        return np.asarray(~(inside.all(axis=2) & (cubes[..., 2] > 0)).all(axis=1))

    def initial(self, rng: np.random.Generator, n: int, qpos0: Array, qvel0: Array) -> tuple[Array, Array]:
        qpos = np.tile(qpos0, (n, 1))
        qpos[:, _ARM] = panda.HOME + 0.02 * rng.standard_normal((n, panda.JOINTS))
        qpos[:, _FINGERS] = OPEN
        # Anywhere before the arm, and beside one another: the first of some places that is far enough away.
        places = rng.uniform([0.42, -0.18], [0.62, 0.18], (n, 12, 2))
        apart = np.linalg.norm(places[:, 1:] - places[:, :1], axis=2)
        other = 1 + np.where((apart > 0.14).any(axis=1), np.argmax(apart > 0.14, axis=1), np.argmax(apart, axis=1))
        qpos[:, _A] = np.column_stack([places[:, 0], np.full(n, HALF_A)])
        qpos[:, _B] = np.column_stack([places[np.arange(n), other], np.full(n, HALF_B)])
        for part in (_A_TURN, _B_TURN):
            yaw = rng.uniform(-np.pi, np.pi, n)
            qpos[:, part] = np.column_stack([np.cos(yaw / 2), np.zeros(n), np.zeros(n), np.sin(yaw / 2)])
        return qpos, np.tile(qvel0, (n, 1))


def _one_of_two(quaternions: Array, part: int) -> Array:
    """Of the two quaternions (N, 4) of each orientation, the one of which that part is not negative."""
    return np.where(quaternions[:, part : part + 1] < 0, -quaternions, quaternions)
