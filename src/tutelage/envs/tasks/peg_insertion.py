"""Peg insertion: an arm grasps a ring by its handle and puts it over a peg; violation: the ring left the table.

The peg insertion of ThriftyDAgger (section 3.5, appendix B.3 of the dissertation), which is robosuite's NutAssemblyRound,
on our own model.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks import arm
from tutelage.envs.tasks.base import Array, Frame, GoalTask

STEP, TWIST = 0.01, 0.2
"""How far one decision moves the gripper along each axis, m, and turns it, rad, at most."""
OPEN, SHUT = 0.04, -0.01
"""Commands of the fingers: distance from the middle, m. They stop at what is between them."""
PEG, PEG_HEIGHT = np.array([0.23, -0.1]), 0.12
"""Where the peg stands (x, y) and how high it is, m."""
CLEARANCE = 0.01
"""Radius of the hole less that of the peg, m."""
THICKNESS = 0.02
"""Of the ring and of its handle, m."""
GRIP = 0.08
"""From the middle of the ring to where its handle is gripped, m."""
LOW_ENOUGH = 0.05
"""A ring on the peg below this height is in the goal set, m."""
TABLE = np.array([[-0.23, -0.33], [0.31, 0.33]])
"""Corners of the table top (x, y), m. Its height is 0."""

_ARM, _VELOCITIES, _FINGERS, _RING, _QUATERNION = slice(0, 6), slice(0, 6), slice(6, 8), slice(8, 11), slice(11, 15)


class PegInsertion(GoalTask):
    """41 observations, 5 actions.

    Observations: sine (6) and cosine (6) of the joint angles, joint velocities (6, rad/s), position of the grip (3, m), its
    heading (cosine and sine of its yaw), distance of a finger from the middle (m) and its velocity (m/s), position of the
    ring (3, m), the unit vector along its handle (3) and the one along its axis (3), position of the ring (3, m) and its
    handle's direction (3) as the gripper sees them, and how high the ring is above the peg's tip (m).

    Actions: three steps of the gripper, its turn, and above 0 "shut", else "open". Violation: the ring left the table.
    Goal: the ring is around the peg, lower than 5 cm, and let go.
    """

    name, xml, frame_skip = "PegInsertion", "peg_insertion.xml", 50
    assets = Path(__file__).parent / "assets"
    fields = ("qpos", "qvel", "site_xpos", "site_xmat")
    push_body, camera = "ring", "fixed"
    horizon = 175
    disturbance = "strong"
    offline_pairs = 2687
    expert = "tutelage.envs.experts.peg_insertion:PegInserter"
    action_low, action_high = (-np.ones(5, dtype=np.float32), np.ones(5, dtype=np.float32))
    summary = "an arm puts a ring over a peg; violation: the ring left the table"

    def control(self, frame: Frame, actions: Array) -> Array:
        place, heading = frame["site_xpos"][:, 0], _heading(frame)
        # From where the gripper is, not from where it was told to be: what is pressed against the table does not wind up.
        place = np.clip(place + STEP * actions[:, :3], arm.LOW, arm.HIGH)
        yaw = np.clip(np.arctan2(heading[:, 1], heading[:, 0]) + TWIST * actions[:, 3], -arm.TURN, arm.TURN)
        fingers = np.where(actions[:, 4] > 0, SHUT, OPEN)
        return np.concatenate([arm.joints(place, yaw), fingers[:, None]], axis=1)

    def observe(self, frame: Frame) -> Array:
        qpos, qvel, place = frame["qpos"], frame["qvel"], frame["site_xpos"][:, 0]
        hand = frame["site_xmat"][:, 0].reshape(-1, 3, 3)
        ring, handle, axis = _ring(frame)
        return np.concatenate(
            [
                np.sin(qpos[:, _ARM]),
                np.cos(qpos[:, _ARM]),
                qvel[:, _VELOCITIES],
                place,
                _heading(frame),
                qpos[:, _FINGERS].mean(axis=1, keepdims=True),
                qvel[:, _FINGERS].mean(axis=1, keepdims=True),
                ring,
                handle,
                axis,
                np.einsum("nij,ni->nj", hand, ring - place),
                np.einsum("nij,ni->nj", hand, handle),
                ring[:, 2:] - PEG_HEIGHT,
            ],
            axis=1,
        )

    def success(self, frame: Frame) -> NDArray[np.bool_]:
        ring, _, axis = _ring(frame)
        around = (
            np.linalg.norm(ring[:, :2] - PEG, axis=1) < 1.2 * CLEARANCE
        )  # a tilted ring's hole is a little off its middle
        let_go = frame["qpos"][:, _FINGERS].min(axis=1) > THICKNESS / 2 + 0.005
        return np.asarray(around & (ring[:, 2] < LOW_ENOUGH) & (np.abs(axis[:, 2]) > 0.8) & let_go)

    def violation(self, frame: Frame) -> NDArray[np.bool_]:
        x, y, z = frame["qpos"][:, _RING].T
        (left, near), (right, far) = TABLE
        return ~((z > -0.02) & (x > left) & (x < right) & (y > near) & (y < far))  # type: ignore[no-any-return]

    def initial(self, rng: np.random.Generator, n: int, qpos0: Array, qvel0: Array) -> tuple[Array, Array]:
        qpos = np.tile(qpos0, (n, 1))
        place, yaw = np.tile([-0.05, 0.0, 0.2], (n, 1)), np.zeros(n)
        qpos[:, _ARM] = arm.joints(place, yaw) + 0.02 * rng.standard_normal((n, arm.JOINTS))
        qpos[:, _FINGERS] = OPEN
        # robosuite's ranges: anywhere on a short line along y, turned any way.
        turn = rng.uniform(-np.pi, np.pi, n)
        qpos[:, _RING] = rng.uniform([-0.115, -0.225, 0.011], [-0.11, -0.11, 0.011], (n, 3))
        qpos[:, _QUATERNION] = np.stack([np.cos(turn / 2), 0 * turn, 0 * turn, np.sin(turn / 2)], axis=1)
        return qpos, np.tile(qvel0, (n, 1))


def _heading(frame: Frame) -> Array:
    """Cosine and sine of the gripper's yaw, (N, 2)."""
    forward = frame["site_xmat"][:, 0].reshape(-1, 3, 3)[:, :2, 0]
    return forward / np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)  # type: ignore[no-any-return]


def _ring(frame: Frame) -> tuple[Array, Array, Array]:
    """Position of the ring, direction of its handle, direction of its axis, (N, 3) each."""
    w, x, y, z = frame["qpos"][:, _QUATERNION].T
    handle = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    return frame["qpos"][:, _RING], handle, axis
