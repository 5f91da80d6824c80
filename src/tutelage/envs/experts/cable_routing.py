"""The algorithmic human for cable routing: a program that sees how the cable lies and knows which way to go round next."""

from __future__ import annotations

import functools
import itertools

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array
from tutelage.envs.tasks.cable_routing import KEEP_OUT, LINKS, PEGS, REACH, STEP, splits

SPEED = 0.75
"""How far it moves in a timestep, in units of `STEP`."""
GOAL, ROUNDS = np.array([0.02, 0.0]), np.array([1, 1, -1, -1])
"""Where the route ends, m, and how often it has been around each peg there, counter-clockwise.

It never gets there: the figure is complete on the way."""
SPACING, NODES = 0.004, 26
"""The map is a grid of so many nodes a side, that far apart, m."""
MARGIN = 0.0015
"""How far the route stays away from the logical obstacles, m."""
DETOUR = 0.5
"""What passing between the pegs of a pair costs, in m of way: it is done only to take it back."""
AHEAD = 2
"""How many nodes around it the next step is chosen from, to each side."""

_AXIS = -REACH + SPACING * np.arange(NODES)
_POINTS = np.stack(np.meshgrid(_AXIS, _AXIS, indexing="ij"), axis=-1)
_SHEETS = np.array(list(itertools.product((-1, 0, 1), repeat=4)))


class CableRouter:
    """Looks at each row alone and keeps no memory, so it can take over in any state.

    Where the gripper is does not say what to do next: what counts as well is how often the cable goes around each peg. It
    has a map of both, with the length of the way that is left, and moves to where less is left. A cable that was laid the
    wrong way round is taken back, because on the map that is the shortest way.
    """

    def act(self, obs: Array) -> Array:
        """Actions (N, 2) float32 for observations (N, 68)."""
        obs = np.asarray(obs, dtype=np.float64)
        gripper = obs[:, :2]
        path = np.concatenate([gripper[:, None], obs[:, 10:].reshape(-1, LINKS - 1, 2)], axis=1)[:, ::-1]
        rounds = crossings(path[:, :-1], path[:, 1:]).sum(axis=1)

        nearest = np.rint((gripper + REACH) / SPACING).astype(int)
        around = np.arange(-AHEAD, AHEAD + 1)
        window = np.stack(np.meshgrid(around, around, indexing="ij"), axis=-1).reshape(-1, 2)
        nodes = np.clip(nearest[:, None] + window, 0, NODES - 1)
        points = _POINTS[nodes[..., 0], nodes[..., 1]]
        start = np.broadcast_to(gripper[:, None], points.shape)
        left = way()[_sheet(rounds[:, None] + crossings(start, points)), nodes[..., 0], nodes[..., 1]]
        distance = np.linalg.norm(points - start, axis=2)
        # All nodes along a shortest way promise the same length: the farthest is best, for it makes the way smooth.
        cost = 0.8 * distance + left + np.where(splits(start, points), DETOUR, 0.0)
        best = np.argmin(cost, axis=1)
        move = np.take_along_axis(points, best[:, None, None], axis=1)[:, 0] - gripper
        length = np.linalg.norm(move, axis=1, keepdims=True)
        move = move * np.minimum(SPEED * STEP / np.maximum(length, 1e-9), 1.0)
        return np.clip(move / STEP, -1.0, 1.0).astype(np.float32)  # type: ignore[no-any-return]


def crossings(start: Array, end: Array) -> NDArray[np.int64]:
    """What straight lines from `start` to `end` (..., 2) add to the rounds about each peg, counter-clockwise, (..., 4).

    A round is counted where it crosses the line from the peg straight outwards, up or down: rounds are whole numbers that
    depend on how the cable lies, and not on where exactly its ends are.
    """
    before, after = (point[..., None, 0] < PEGS[:, 0] for point in (start, end))
    width = end[..., None, 0] - start[..., None, 0]
    part = (PEGS[:, 0] - start[..., None, 0]) / np.where(before != after, width, 1.0)
    y = start[..., None, 1] + part * (end[..., None, 1] - start[..., None, 1])
    side = np.sign(PEGS[:, 1])
    beyond = (y - PEGS[:, 1]) * side > 0
    return np.where((before != after) & beyond, side * np.where(after, 1, -1), 0).astype(np.int64)


def _sheet(rounds: Array) -> NDArray[np.intp]:
    """Index of (..., 4) rounds on the map. More than one round counts as one: the next step is the same."""
    return np.clip(rounds, -1, 1) @ np.array([27, 9, 3, 1]) + 40  # type: ignore[no-any-return]


@functools.cache
def way() -> Array:
    """Length of the way that is left, m, by rounds (81) and place (26 x 26); infinite where the gripper should not be."""
    gaps = np.linalg.norm(_POINTS[:, :, None] - PEGS, axis=-1).min(axis=-1)
    free = gaps > KEEP_OUT + MARGIN
    index = np.arange(NODES)
    targets, costs = [], []
    for move in itertools.product((-1, 0, 1), repeat=2):
        if not any(move):
            continue
        i, j = (np.clip(index + m, 0, NODES - 1) for m in move)
        there = _POINTS[np.ix_(i, j)]
        sheet = _sheet(_SHEETS[:, None, None] + crossings(_POINTS, there))
        targets.append((sheet * NODES + i[:, None]) * NODES + j)
        length = np.linalg.norm(there - _POINTS, axis=-1) + np.where(splits(_POINTS, there), DETOUR, 0.0)
        costs.append(np.where(free & free[np.ix_(i, j)], length, np.inf))
    left = np.full((len(_SHEETS), NODES, NODES), np.inf)
    end = np.rint((GOAL + REACH) / SPACING).astype(int)
    left[_sheet(ROUNDS), end[0], end[1]] = 0.0
    while True:  # Bellman's equation, until nothing gets shorter
        shorter = left
        for target, cost in zip(targets, costs, strict=True):
            shorter = np.minimum(shorter, cost + left.ravel()[target])
        if np.array_equal(shorter, left):
            return left
        left = shorter
