"""The algorithmic human for peg insertion: a program that looks at the robot's state and knows what comes next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks import arm
from tutelage.envs.tasks.base import Array
from tutelage.envs.tasks.peg_insertion import GRIP, OPEN, PEG, PEG_HEIGHT, STEP, THICKNESS, TWIST

Mask = NDArray[np.bool_]

_GRIP, _HEADING, _FINGER, _RING, _HANDLE, _AXIS = (
    slice(18, 21),
    slice(21, 23),
    23,
    slice(25, 28),
    slice(28, 31),
    slice(31, 34),
)

OVER_HANDLE, OVER_PEG, DOWN = 0.06, 0.03, 0.03
"""How high the grip approaches above the handle, the ring above the tip of the peg; where the ring is let go, m."""
CLOSE, STRAIGHT, CENTRED = 0.008, 0.12, 0.007
"""Near enough to the handle to go down to it, m; turned well enough, rad; near enough to the peg's axis to go down, m."""
KEEP_AWAY = 0.1
"""Nearer to the peg's axis than this, an empty gripper moves sideways only above its tip, m."""
SPREAD, FREE = 0.046, 0.04
"""From the grip to the middle of an open finger; what it needs from the peg's axis, m."""
UPRIGHT = 0.7
"""Cosine of how far a held ring may hang over."""
ASIDE = np.array([-0.15, 0.0])
"""From the peg to where a ring that hangs over is dropped, to be gripped better, m."""


class PegInserter:
    """Looks at each row alone and keeps no memory, so it can take over in any state: whatever went wrong, the next step
    follows from where gripper and ring are now.

    Without the ring: rise, go above the handle and turn across it, go down with open fingers, shut them. With it: rise above
    the peg's tip, go above the peg, go down, let go. A ring whose handle is too near to the peg for the fingers is first
    hooked by its hole, with the fingers shut, and dragged away.
    """

    def act(self, obs: Array) -> Array:
        """Actions (N, 5) float32 for observations (N, 41)."""
        obs = np.asarray(obs, dtype=np.float64)
        grip, ring, handle, finger = obs[:, _GRIP], obs[:, _RING], obs[:, _HANDLE], obs[:, _FINGER]
        point = ring + GRIP * handle  # where the handle is gripped
        yaw, bearing = (np.arctan2(obs[:, part][:, 1], obs[:, part][:, 0]) for part in (_HEADING, _HANDLE))
        turn = _turn(yaw, bearing)
        between = (finger > 0.3 * THICKNESS) & (finger < 0.7 * THICKNESS)
        held = between & (np.linalg.norm(point - grip, axis=1) < 0.025)
        blocked = ~held & (point[:, 2] < PEG_HEIGHT) & _blocked(point, bearing)

        move, shut = _fetch(grip, point, turn, finger)
        for mask, (other_move, other_shut) in (
            (blocked, _drag(grip, ring, finger)),
            (held, _carry(grip, ring, obs[:, _AXIS])),
        ):
            move, shut = np.where(mask[:, None], other_move, move), np.where(mask, other_shut, shut)
        twist = np.where(held, 0.0, turn / TWIST)
        command = np.column_stack([move / STEP, twist, np.where(shut, 1.0, -1.0)])
        return np.clip(command, -1.0, 1.0).astype(np.float32)  # type: ignore[no-any-return]


def _turn(yaw: Array, bearing: Array) -> Array:
    """The smallest turn (N,), rad, after which the fingers close across the handle: either way round will do."""
    turn: Array = (bearing - yaw + np.pi / 2) % np.pi - np.pi / 2
    return np.where(np.abs(yaw + turn) > arm.TURN - 0.1, turn - np.sign(yaw + turn) * np.pi, turn)


def _blocked(point: Array, bearing: Array) -> Mask:
    """Whether the peg stands where an open finger must go to grip the handle, (N,)."""
    across = SPREAD * np.stack([-np.sin(bearing), np.cos(bearing)], axis=1)
    gaps = [np.linalg.norm(point[:, :2] + side * across - PEG, axis=1) for side in (1, -1)]
    return np.minimum(*gaps) < FREE  # type: ignore[no-any-return]


def _approach(grip: Array, target: Array, there: Mask, ready: Mask) -> Array:
    """Move (N, 3), m, to a target: over it first, and down to it when `there` (above it) and `ready` (the fingers)."""
    away = target - grip
    height = target[:, 2] + OVER_HANDLE
    beside = np.linalg.norm(grip[:, :2] - PEG, axis=1) < KEEP_AWAY
    height = np.where(beside, np.maximum(height, PEG_HEIGHT + OVER_PEG), height)
    # Low and not there: rise first, or the fingers push the ring about. The fingers open or shut up there as well.
    low = (height - grip[:, 2] > 0.02) & ~(there & ready)
    level = np.where(low[:, None], 0.0, away[:, :2])
    return np.column_stack([level, np.where(there & ready, away[:, 2], height - grip[:, 2])])


def _fetch(grip: Array, point: Array, turn: Array, finger: Array) -> tuple[Array, Mask]:
    """Grip the handle at a point: where to move, (N, 3), m, and whether to shut the fingers, (N,)."""
    there = (np.linalg.norm((point - grip)[:, :2], axis=1) < CLOSE) & (np.abs(turn) < STRAIGHT)
    return _approach(grip, point, there, finger > 0.8 * OPEN), there & (np.abs(point - grip)[:, 2] < CLOSE)


def _drag(grip: Array, ring: Array, finger: Array) -> tuple[Array, Mask]:
    """Put shut fingers into the hole and move away from the peg: likewise."""
    inside = np.linalg.norm((ring - grip)[:, :2], axis=1) < 2 * CLOSE
    hooked = inside & (grip[:, 2] - ring[:, 2] < 3 * CLOSE)
    outward = ring[:, :2] - PEG
    outward = STEP * outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    pull = np.column_stack([outward, np.minimum(ring[:, 2] - grip[:, 2], 0.0)])
    move = np.where(hooked[:, None], pull, _approach(grip, ring, inside, finger < 0.3 * THICKNESS))
    return move, np.ones(len(ring), dtype=bool)


def _carry(grip: Array, ring: Array, axis: Array) -> tuple[Array, Mask]:
    """Bring the ring to the peg and let go of it there; one that hangs over is put aside instead: likewise."""
    far = np.linalg.norm(ring[:, :2] - PEG, axis=1)
    hangs = np.abs(axis[:, 2]) < UPRIGHT
    threaded = (far < 0.012) & (ring[:, 2] < PEG_HEIGHT)
    down = (threaded | (far < CENTRED)) & ~hangs
    height = PEG_HEIGHT + OVER_PEG - ring[:, 2]
    low = ~down & (height > 0.015)
    away = PEG + np.where(hangs[:, None], ASIDE, 0.0) - ring[:, :2]
    move = np.column_stack([np.where(low[:, None], 0.0, away), np.where(down, DOWN - 0.01 - ring[:, 2], height)])
    lowest = (ring[:, 2] < DOWN) | (grip[:, 2] < arm.LOW[2] + CLOSE)
    let_go = np.where(hangs, far > 0.8 * abs(ASIDE[0]), lowest & (far < 2 * CENTRED))
    return move, ~let_go
