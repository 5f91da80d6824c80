"""The algorithmic humans for block pushing: programs that look at where block and goal are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array
from tutelage.envs.tasks.block_pushing import FACES, RING, STEP, BlockPushing, rotate
from tutelage.policies.kinds import Kinds

MARGIN = 0.01
"""How far from what it must not touch a push should leave the block, m."""
EQUAL = 0.5
"""Ways around the obstacle that differ by less than this, rad, are equally long."""
AHEAD = 0.32
"""How far ahead on the ring a push aims, rad."""


class Pusher:
    """Of the four pushes, the one after which the block is nearest to the goal and well inside. Looks at each row alone."""

    def act(self, obs: Array) -> Array:
        """Actions (N, 4) float32 for observations (N, 6): 1 for the push that is wanted, -1 for the others."""
        obs = np.asarray(obs, dtype=np.float64)
        block, angle, goal = _read(obs)
        after = block[:, None] + STEP * np.stack([rotate(np.tile(face, (len(obs), 1)), angle) for face in FACES], axis=1)
        far = np.linalg.norm(after - goal[:, None], axis=2)
        far = far + 10.0 * _unsafe(after, angle)
        best = np.argmin(far, axis=1)
        return np.where(np.arange(4) == best[:, None], 1.0, -1.0).astype(np.float32)


def _unsafe(after: Array, angle: Array) -> NDArray[np.bool_]:
    """Which blocks at (N, K, 2), turned by (N,), are not inside with a margin to every side, (N, K)."""
    n, k = after.shape[:2]
    task, turned = BlockPushing(), np.repeat(angle, k)
    found = np.zeros(n * k, dtype=bool)
    for shift in MARGIN * FACES:
        found |= task.outside(np.concatenate([after.reshape(-1, 2) + shift, turned[:, None]], axis=1))
    return found.reshape(n, k)


class Circler:
    """Pushes the block along a ring around the obstacle, the shorter way, and its own way if both are equally long.

    Looks at each row alone and keeps no memory, so it can take over in any state.

    Args:
        turn: 1 for counter-clockwise, -1 for clockwise.
    """

    def __init__(self, turn: int) -> None:
        self.turn = turn

    def act(self, obs: Array) -> Array:
        """Actions (N, 2) float32 for observations (N, 6)."""
        block, _, goal = _read(np.asarray(obs, dtype=np.float64))
        bearing, there = np.arctan2(block[:, 1], block[:, 0]), np.arctan2(goal[:, 1], goal[:, 0])
        left = (there - bearing) % (2 * np.pi)  # counter-clockwise
        longer = 2 * left - 2 * np.pi
        turn = np.where(np.abs(longer) < EQUAL, self.turn, -np.sign(longer))
        remaining = np.where(turn > 0, left, 2 * np.pi - left)
        aim = bearing + turn * AHEAD
        target = np.where((remaining < AHEAD)[:, None], goal, RING * np.stack([np.cos(aim), np.sin(aim)], axis=1))
        way = (target - block) / STEP
        way /= np.maximum(np.abs(way).max(axis=1, keepdims=True), 1.0)
        return way.astype(np.float32)


def counterclockwise() -> Circler:
    """A human who goes round the obstacle counter-clockwise."""
    return Circler(1)


def clockwise() -> Circler:
    """A human who goes round the obstacle clockwise."""
    return Circler(-1)


def team() -> Kinds:
    """Human 1 of section 6.5 goes clockwise, human 2 counter-clockwise, and so on."""
    return Kinds([clockwise(), counterclockwise()])


def _read(obs: Array) -> tuple[Array, Array, Array]:
    """Where the block is (N, 2), how it is turned (N,), where the goal is (N, 2), from observations (N, 6)."""
    return obs[:, :2], np.arctan2(obs[:, 3], obs[:, 2]) / 4, obs[:, 4:6]
