"""The six-joint arm of the manipulation tasks: where must its joints be for the gripper to be somewhere?

An arm with the link lengths of a UR5e whose gripper points straight down has a closed-form answer, so a fleet of arms costs
a few array operations a timestep.
"""

from __future__ import annotations

import numpy as np

from tutelage.envs.tasks.base import Array

JOINTS = 6
BASE = np.array([-0.45, 0.0, 0.0])
"""Where the arm stands, m."""
SHOULDER, UPPER, FORE, ASIDE, FORWARD = 0.1625, 0.425, 0.3922, 0.1333, 0.0997
"""Height of the shoulder, lengths of upper arm and forearm, offsets of the wrist to the left and forward, m."""
GRIP = 0.0996 + 0.18
"""From the last elbow of the wrist down to the middle of the finger pads, m."""
LOW, HIGH = np.array([-0.26, -0.38, 0.012]), np.array([0.36, 0.38, 0.25])
"""The box in which the gripper moves, m: all of the table and a little more. The arm stretches towards what is too far."""
TURN = 1.8
"""The gripper's yaw stays within plus or minus this, rad: a little more than the half turn that a parallel gripper needs."""


def joints(position: Array, yaw: Array) -> Array:
    """Angles (N, 6), rad, that bring the grip to a position (N, 3), m, and yaw (N,), rad, with the gripper pointing down."""
    x, y, z = (position - BASE).T
    out = np.sqrt(np.maximum(x * x + y * y - ASIDE**2, 1e-6))  # forward distance in the plane in which the arm bends
    pan = np.arctan2(y, x) - np.arctan2(ASIDE, out)
    ahead, above = out - FORWARD, z + GRIP - SHOULDER
    bend = (ahead**2 + above**2 - UPPER**2 - FORE**2) / (2 * UPPER * FORE)
    elbow = np.arccos(np.clip(bend, -1.0, 1.0))
    lift = -np.arctan2(above, ahead) - np.arctan2(FORE * np.sin(elbow), UPPER + FORE * np.cos(elbow))
    return np.stack([pan, lift, elbow, -lift - elbow, np.zeros_like(pan), pan - yaw], axis=1)
