"""The algorithmic human for cable routing: a program that sees how the cable lies and knows which way to go round next."""

from __future__ import annotations

import functools
import itertools

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array
from tutelage.envs.tasks.cable_routing import KEEP_OUT, LINKS, PEGS, REACH, STEP

Ints = NDArray[np.int64]

SPEED = 0.75
"""How far it moves in a timestep, in units of `STEP`."""
GOAL = np.array([0.02, 0.0])
"""Where the route ends, m. It never gets there: the figure is complete on the way."""
SPACING, NODES = 0.004, 26
"""Its map is a grid of so many nodes a side, that far apart, m."""
MARGIN = 0.0015
"""How far the route stays away from the logical obstacles, m."""
AHEAD = 2
"""How many nodes around it the next step is chosen from, to each side."""

_UP = np.array([0.0, 1.0])
CUTS = np.array([[PEGS[0], PEGS[0] + _UP], [PEGS[0], PEGS[1]], [PEGS[2], PEGS[2] - _UP], [PEGS[2], PEGS[3]]])
"""Four lines, m: from the left peg of each pair outwards, and to the right peg."""
UPPER, LOWER = 1, -3
"""The figure crosses the two lines that go outwards, from right to left, and no other: one around each pair."""

_START, _UPPER_DONE, _LOWER_DONE, _CLOSE, _TAKE_BACK, _END = 0, 1, 2, 3, 8, 13
"""Stages of the work. Stage 8 + k takes back the crossing k, which is one of -4 to -1 and 1 to 4."""
_NEXT = np.full((_END, 9), -1)
"""The stage after a crossing k - 4, by stage and k; -1: not a crossing to make."""
_NEXT[:_END, 4] = np.arange(_END)
_NEXT[_START, [4 + UPPER, 4 + LOWER]] = _UPPER_DONE, _LOWER_DONE
_NEXT[_UPPER_DONE, 4 + LOWER] = _NEXT[_LOWER_DONE, 4 + UPPER] = _CLOSE
_NEXT[np.arange(4, 13), np.arange(8, -1, -1)] = _END
_AXIS = -REACH + SPACING * np.arange(NODES)
_POINTS = np.stack(np.meshgrid(_AXIS, _AXIS, indexing="ij"), axis=-1)


class CableRouter:
    """Looks at each row alone and keeps no memory, so it can take over in any state.

    Where the gripper is does not say what to do next; how the cable lies does. Four lines between and beside the pegs make
    a word of it: the lines that it crosses, one after the other. If the word is a beginning of the figure's, the next
    crossing is the figure's next. If not, the last crossing is taken back: what was laid wrong is undone the way it came.
    """

    def act(self, obs: Array) -> Array:
        """Actions (N, 2) float32 for observations (N, 68)."""
        obs = np.asarray(obs, dtype=np.float64)
        gripper = obs[:, :2]
        cable = np.concatenate([gripper[:, None], obs[:, 10:].reshape(-1, LINKS - 1, 2)], axis=1)
        stage = stages(cable[:, ::-1])

        around = np.arange(-AHEAD, AHEAD + 1)
        window = np.stack(np.meshgrid(around, around, indexing="ij"), axis=-1).reshape(-1, 2)
        nearest = np.rint((gripper + REACH) / SPACING).astype(int)
        i, j = np.moveaxis(np.clip(nearest[:, None] + window, 0, NODES - 1), -1, 0)
        points = _POINTS[i, j]
        after = _NEXT[stage[:, None], 4 + crossings(np.broadcast_to(gripper[:, None], points.shape), points)]
        left = np.where(after < 0, np.inf, way()[after, i, j])
        # All nodes along a shortest way promise the same length: the farthest is best, for it makes the way smooth.
        cost = 0.8 * np.linalg.norm(points - gripper[:, None], axis=2) + left
        best = np.argmin(cost, axis=1)
        move = np.take_along_axis(points, best[:, None, None], axis=1)[:, 0] - gripper
        length = np.linalg.norm(move, axis=1, keepdims=True)
        move = move * np.minimum(SPEED * STEP / np.maximum(length, 1e-9), 1.0)
        return np.clip(move / STEP, -1.0, 1.0).astype(np.float32)  # type: ignore[no-any-return]


def crossings(start: Array, end: Array) -> Ints:
    """Which line, 1 to 4, straight ways from `start` to `end` (..., 2) cross, (...): negative in one direction, 0 for none.

    Ways are short: none crosses two lines.
    """
    found = np.zeros(start.shape[:-1], dtype=np.int64)
    for number, (foot, tip) in enumerate(CUTS, start=1):
        before, after = _side(foot, tip, start), _side(foot, tip, end)
        through = (_side(start, end, foot) < 0) != (_side(start, end, tip) < 0)
        found = np.where(((before < 0) != (after < 0)) & through, np.where(before < 0, number, -number), found)
    return found


def _side(start: Array, end: Array, point: Array) -> Array:
    """Positive where points lie to the left of lines, (...)."""
    along, to = end - start, point - start
    return along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0]  # type: ignore[no-any-return]


def stages(path: Array) -> Ints:
    """What is next, (N,), for cables that lie along paths (N, P, 2) from the free end to the gripper."""
    n = len(path)
    rows, depth, word = np.arange(n), np.zeros(n, dtype=np.int64), np.zeros((n, path.shape[1] + 1), dtype=np.int64)
    for letter in crossings(path[:, :-1], path[:, 1:]).T:  # there and back again is nothing
        back = (letter != 0) & (word[rows, depth] == -letter)
        on = (letter != 0) & ~back
        depth += on.astype(np.int64) - back
        word[rows[on], depth[on]] = letter[on]
    last, stage = word[rows, depth], np.zeros(n, dtype=np.int64)
    for length in (1, 2):
        good = _NEXT[stage, 4 + word[:, length]]
        stage = np.where(depth < length, stage, np.where((good == stage) | (good < 0) | (stage < 0), -1, good))
    return np.where((depth > 2) | (stage < 0), _TAKE_BACK + last, stage)


@functools.cache
def way() -> Array:
    """Length of the way that is left, m, by stage (14) and place (26 x 26); infinite where the gripper should not be."""
    gaps = np.linalg.norm(_POINTS[:, :, None] - PEGS, axis=-1).min(axis=-1)
    free = gaps > KEEP_OUT + MARGIN
    index, every = np.arange(NODES), np.arange(_END)[:, None, None]
    moves = []
    for move in itertools.product((-1, 0, 1), repeat=2):
        i, j = (np.clip(index + step, 0, NODES - 1) for step in move)
        there = _POINTS[np.ix_(i, j)]
        after = _NEXT[every, 4 + crossings(_POINTS, there)]
        length = np.where(free & free[np.ix_(i, j)], np.linalg.norm(there - _POINTS, axis=-1), np.inf)
        moves.append((after, i[:, None], j, np.where(after < 0, np.inf, length)))
    left = np.full((_END + 1, NODES, NODES), np.inf)
    left[_END] = 0.0
    left[(_CLOSE, *np.rint((GOAL + REACH) / SPACING).astype(int))] = 0.0
    while True:  # Bellman's equation, until nothing gets shorter
        shorter = left.copy()
        for after, i, j, length in moves:
            shorter[:_END] = np.minimum(shorter[:_END], length + left[after, i, j])
        if np.array_equal(shorter, left):
            return left
        left = shorter
