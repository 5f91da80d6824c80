"""The seven-joint arm of cube stacking: which way must its joints turn for the gripper to move?

Damped least squares (Nakamura and Hanafusa, 1986; Wampler, 1986) on the geometric Jacobian, for a fleet of arms at once.
"""

from __future__ import annotations

import numpy as np

from tutelage.envs.tasks.base import Array

JOINTS = 7
HOME = np.array([0.0, 0.2, 0.0, -2.2, 0.0, 2.4, 0.0])
"""Joint angles, rad, with the gripper straight down above the table; the arm keeps near them where it has a choice."""
RANGE = np.array(
    [
        [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -4.0],
        [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 4.0],
    ]
)
"""Least and greatest joint angles, rad."""
DAMPING = 0.03
"""How much a turn of the joints costs (m/rad), which keeps them slow where the arm is stretched or folded."""
RETURN = np.array([0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.0])
"""Part of the way to `HOME` that the joints go in a timestep where the gripper does not mind. The last one is the yaw."""


def turn(joints: Array, place: Array, anchors: Array, axes: Array, move: Array) -> Array:
    """Changes (N, 7) of the joint angles, rad, that move and turn the gripper.

    Args:
        joints: (N, 7) joint angles, rad.
        place: (N, 3) where the grip is, m.
        anchors, axes: (N, 7, 3) where the joints' axes are, m, and their directions.
        move: (N, 6) how far the grip is to move, m, and how far to turn, as a rotation vector, rad.
    """
    jacobian = np.concatenate([np.cross(axes, place[:, None] - anchors), axes], axis=2)  # (N, 7, 6)
    across = jacobian.transpose(0, 2, 1)
    aside = RETURN * (HOME - joints)
    wanted = move[..., None] - across @ aside[..., None]
    damped = across @ jacobian + DAMPING**2 * np.eye(6)
    return aside + (jacobian @ np.linalg.solve(damped, wanted))[..., 0]  # type: ignore[no-any-return]
