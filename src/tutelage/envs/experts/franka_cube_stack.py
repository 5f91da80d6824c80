"""The algorithmic humans for cube stacking: four programs that differ in how they turn the gripper to grip the cube."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array
from tutelage.envs.tasks.franka_cube_stack import HALF_A, HALF_B, OPEN, STEP, TWIST
from tutelage.policies.kinds import Kinds

Mask = NDArray[np.bool_]

_TURN, _CUBE, _WAY, _GRIP, _HEADING, _FINGERS = (
    slice(0, 4),
    slice(4, 7),
    slice(7, 10),
    slice(10, 13),
    slice(13, 17),
    slice(17, 19),
)

OVER, CLEAR = 0.09, 0.03
"""How high above a cube the grip approaches it; how high a held cube passes above the other one, m."""
STRAIGHT, CENTRED, BETWEEN = 0.12, 0.007, 0.013
"""Turned well enough, rad, and near enough to the middle of a cube, m, to go down to it; still between the fingers, m."""
LAID = 0.006
"""Let go of a cube that is no higher than this above its place, m."""
EDGE = 0.1
"""So near to 0 or pi / 2 an angle counts as both, rad."""
GAIN = 0.5
"""Part of the way that is gone in a timestep, where that is less than all that it can do."""


class Stacker:
    """Looks at each row alone and keeps no memory, so it can take over in any state.

    Seven stages (appendix D.4): move above cube A; turn the gripper; go down; lift; move above cube B; put the cube down;
    let go, and rise.

    Args:
        grasp: the angle between the gripper and the cube, rad: 0, or minus or plus a quarter or half turn from the angle
            within [0, pi / 2] that closes the fingers on two of the cube's faces.
    """

    def __init__(self, grasp: float) -> None:
        self.grasp = grasp

    def act(self, obs: Array) -> Array:
        """Actions (N, 7) float32 for observations (N, 19)."""
        obs = np.asarray(obs, dtype=np.float64)
        cube, grip = obs[:, _CUBE], obs[:, _GRIP]
        place = cube + obs[:, _WAY] + [0.0, 0.0, HALF_A + HALF_B]
        yaw = 2 * np.arctan2(obs[:, _HEADING][:, 2], obs[:, _HEADING][:, 1])
        face = _face(obs[:, _TURN])
        # Its own grasp where it is still free to choose; beside the cube, the one that the gripper is nearest to.
        beside = np.linalg.norm((cube - grip)[:, :2], axis=1) + np.maximum(grip[:, 2] - cube[:, 2] - 0.6 * OVER, 0) < 0.015
        nearest = (face - yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4
        turn = np.where(beside, nearest, _turn(face + self.grasp, yaw, face))

        finger = obs[:, _FINGERS].mean(axis=1)
        held = (np.abs(finger - HALF_A) < 0.004) & (np.abs(cube - grip).max(axis=1) < HALF_A)
        laid = (np.linalg.norm((place - cube)[:, :2], axis=1) < 0.012) & (np.abs(cube - place)[:, 2] < LAID)
        move, shut = _fetch(grip, cube, turn, finger)
        carry, still = _carry(grip, cube, place)
        up = np.column_stack([np.zeros((len(obs), 2)), np.full(len(obs), STEP)])
        free = finger > 0.8 * OPEN
        move = np.where(laid[:, None], np.where(free[:, None], up, 0.0), np.where(held[:, None], carry, move))
        shut = np.where(laid, False, np.where(held, still, shut))
        turn = np.where(laid | held, 0.0, turn)
        command = np.column_stack([GAIN * move / STEP, _upright(obs[:, _HEADING], turn) / TWIST, np.where(shut, 1.0, -1.0)])
        return np.asarray(np.clip(command, -1.0, 1.0), dtype=np.float32)


def _face(turn: Array) -> Array:
    """The angle theta within [0, pi / 2], rad, at which fingers close on two faces of a cube of orientation (N, 4), (N,)."""
    w, x, y, z = turn.T
    along = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    aside = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1)
    level = np.where(np.abs(along[:, 2:]) < 0.7, along, aside)  # a cube may lie on any of its faces
    return np.arctan2(level[:, 1], level[:, 0]) % (np.pi / 2)


def _turn(target: Array, yaw: Array, face: Array) -> Array:
    """How far to turn to the target, (N,), rad, without turning all the way round.

    A cube whose angle is next to 0 or pi / 2 is next to both, and may not be now the one and now the other: the target that
    is nearer to where the gripper is.
    """
    turn = target - yaw
    other = turn + np.where(face < np.pi / 4, np.pi / 2, -np.pi / 2)
    edge = np.minimum(face, np.pi / 2 - face) < EDGE
    turn = np.where(edge & (np.abs(other) < np.abs(turn)), other, turn)
    return turn - 2 * np.pi * np.rint(turn / (3 * np.pi))


def _fetch(grip: Array, cube: Array, turn: Array, finger: Array) -> tuple[Array, Mask]:
    """Stages 1 to 3: how to move to grip the cube, (N, 3), m, and whether to shut the fingers, (N,)."""
    away = cube - grip
    far = np.linalg.norm(away[:, :2], axis=1)
    low = grip[:, 2] - cube[:, 2] < 0.6 * OVER
    ready = (far < np.where(low, BETWEEN, CENTRED)) & (np.abs(turn) < STRAIGHT) & (finger > 0.8 * OPEN)
    there = (far < BETWEEN) & (np.abs(away[:, 2]) < CENTRED)
    # Low, and not there: rise first, or the fingers push the cube about.
    astray = low & ~ready & ~there
    height = np.where(ready | there, away[:, 2], OVER + away[:, 2])
    return np.column_stack([np.where(astray[:, None], 0.0, away[:, :2]), height]), there


def _carry(grip: Array, cube: Array, place: Array) -> tuple[Array, Mask]:
    """Stages 4 to 6: how to bring a held cube to its place: likewise."""
    away = place - cube
    far = np.linalg.norm(away[:, :2], axis=1)
    above = far < CENTRED
    height = np.where(above, away[:, 2], CLEAR + away[:, 2])
    low = ~above & (height > 0.03)
    return np.column_stack([np.where(low[:, None], 0.0, away[:, :2]), height]), np.ones(len(cube), dtype=bool)


def _upright(heading: Array, turn: Array) -> Array:
    """How the gripper is to turn, (N, 3), rad about the world's axes: by `turn` (N,), and so that it looks straight down."""
    w, x, y, z = heading.T
    down = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    tilt = np.cross(down, [0.0, 0.0, -1.0])
    return np.asarray(tilt + turn[:, None] * [0.0, 0.0, 1.0])


def team() -> Kinds:
    """Four kinds of humans, who grip different faces of the cube."""
    return Kinds([Stacker(grasp) for grasp in (0.0, -np.pi, -np.pi / 2, np.pi / 2)])
