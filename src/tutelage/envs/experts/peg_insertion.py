"""The algorithmic human for peg insertion: a program that looks at the robot's state and knows what comes next."""

from __future__ import annotations

import numpy as np

from tutelage.envs.tasks import arm
from tutelage.envs.tasks.base import Array
from tutelage.envs.tasks.peg_insertion import GRIP, OPEN, PEG, PEG_HEIGHT, STEP, THICKNESS, TWIST

_GRIP, _HEADING, _FINGER, _RING, _HANDLE = slice(18, 21), slice(21, 23), 23, slice(25, 28), slice(28, 31)

OVER_HANDLE, OVER_PEG, DOWN = 0.06, 0.03, 0.03
"""How high the grip approaches above the handle, the ring above the tip of the peg; where the ring is let go, m."""
CLOSE, STRAIGHT, CENTRED = 0.008, 0.12, 0.007
"""Near enough to the handle to go down to it, m; turned well enough, rad; near enough to the peg's axis to go down, m."""


class PegInserter:
    """Looks at each row alone and keeps no memory, so it can take over in any state: whatever went wrong, the next step
    follows from where gripper and ring are now.

    Without the ring: rise, go above the handle and turn across it, go down with open fingers, shut them. With it: rise above
    the peg's tip, go above the peg, go down, let go.
    """

    def act(self, obs: Array) -> Array:
        """Actions (N, 5) float32 for observations (N, 41)."""
        obs = np.asarray(obs, dtype=np.float64)
        grip, ring, finger = obs[:, _GRIP], obs[:, _RING], obs[:, _FINGER]
        point = ring + GRIP * obs[:, _HANDLE]  # where the handle is gripped
        yaw = np.arctan2(obs[:, _HEADING][:, 1], obs[:, _HEADING][:, 0])
        turn = _turn(yaw, np.arctan2(obs[:, _HANDLE][:, 1], obs[:, _HANDLE][:, 0]))

        shut_on_something = (finger > 0.3 * THICKNESS) & (finger < 0.7 * THICKNESS)
        held = shut_on_something & (np.linalg.norm(point - grip, axis=1) < 0.025)
        move, shut = np.where(held[:, None], _carry(ring), _fetch(grip, point, turn, finger)), _shut(grip, point, turn, finger)
        let_go = held & (ring[:, 2] < DOWN) & (np.linalg.norm(ring[:, :2] - PEG, axis=1) < 2 * CENTRED)
        twist = np.where(held, 0.0, np.clip(turn / TWIST, -1, 1))
        fingers = np.where((held & ~let_go) | (~held & shut), 1.0, -1.0)
        return np.concatenate([np.clip(move / STEP, -1, 1), twist[:, None], fingers[:, None]], axis=1).astype(np.float32)


def _turn(yaw: Array, handle: Array) -> Array:
    """The smallest turn (N,), rad, after which the fingers close across the handle: either way round will do."""
    turn = (handle - yaw + np.pi / 2) % np.pi - np.pi / 2
    return np.where(np.abs(yaw + turn) > arm.TURN - 0.1, turn - np.sign(yaw + turn) * np.pi, turn)


def _at_handle(grip: Array, point: Array, turn: Array) -> Array:
    """Whether the gripper is above or around the handle and turned across it, (N,)."""
    return (np.linalg.norm((point - grip)[:, :2], axis=1) < CLOSE) & (np.abs(turn) < STRAIGHT)


def _fetch(grip: Array, point: Array, turn: Array, finger: Array) -> Array:
    """Where to move without the ring, (N, 3), m."""
    away = point - grip
    far = np.linalg.norm(away[:, :2], axis=1)
    hover = away[:, 2] + OVER_HANDLE
    # Low and beside the handle: rise first, or the fingers push the ring about. The fingers open up there as well.
    low = (hover > 0.02) & ((far > CLOSE) | (np.abs(turn) > STRAIGHT) | (finger < 0.8 * OPEN))
    ready = _at_handle(grip, point, turn) & (finger > 0.8 * OPEN)
    level = np.where(low[:, None], 0.0, away[:, :2])
    return np.concatenate([level, np.where(ready, away[:, 2], hover)[:, None]], axis=1)


def _shut(grip: Array, point: Array, turn: Array, finger: Array) -> Array:
    """Whether the fingers are around the handle and should close, (N,)."""
    return _at_handle(grip, point, turn) & (np.abs(point - grip)[:, 2] < CLOSE)


def _carry(ring: Array) -> Array:
    """Where to move with the ring, (N, 3), m."""
    away = PEG - ring[:, :2]
    far = np.linalg.norm(away, axis=1)
    threaded = (far < 0.012) & (ring[:, 2] < PEG_HEIGHT)
    down = threaded | (far < CENTRED)
    height = PEG_HEIGHT + OVER_PEG - ring[:, 2]
    low = ~down & (height > 0.015)
    level = np.where(low[:, None], 0.0, away)
    return np.concatenate([level, np.where(down, DOWN - 0.01 - ring[:, 2], height)[:, None]], axis=1)
