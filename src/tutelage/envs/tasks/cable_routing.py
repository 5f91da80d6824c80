"""Cable routing: a gripper draws a cable around four pegs into a figure 8; violation: its free end was drawn in.

The cable routing of ThriftyDAgger (section 3.5, appendix B.3 of the dissertation), where a surgical robot did it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array, Frame, GoalTask

STEP = 0.01
"""How far one decision moves the gripper along each axis at most, m."""
REACH = 0.05
"""The gripper stays within this distance of the middle along each axis, m."""
PEGS = np.array([[-0.02, 0.02], [0.02, 0.02], [-0.02, -0.02], [0.02, -0.02]])
"""Where the pegs stand (x, y), m: the pair of the upper loop, the pair of the lower one."""
KEEP_OUT = 0.01
"""Radius of the logical obstacle around each peg, m: the gripper goes no nearer."""
LINKS, LINK = 30, 0.012
"""How many links the cable has, and how long one is, m."""
START = np.array([-0.04, 0.0])
"""Where the gripper starts (x, y), m."""
TABLE = np.array([[-0.45, -0.3], [0.15, 0.3]])
"""Corners of the table top (x, y), m. Its height is 0."""

_UPPER, _LOWER = slice(0, 2), slice(2, 4)


class CableRouting(GoalTask):
    """68 observations, 2 actions.

    Observations: the gripper (x, y, m), the way from each of four pegs to it (8, m), and the cable's joints from the gripper
    to the free end (29 times x, y, m).

    Actions: steps of the gripper along x and y. A step that would end in a logical obstacle ends on its border instead.
    Violation: the free end of the cable is among the pegs, where too little of it is left, or the cable left the table.
    Goal: the cable lies in a figure 8, see `figure_eight`.
    """

    name, xml, frame_skip = "CableRouting", "cable_routing.xml", 20
    assets = Path(__file__).parent / "assets"
    fields = ("xpos",)
    push_body, camera = "link 6", "fixed"
    horizon = 100
    disturbance = "extreme"
    offline_pairs = 1381
    expert = "tutelage.envs.experts.cable_routing:CableRouter"
    action_low, action_high = (-np.ones(2, dtype=np.float32), np.ones(2, dtype=np.float32))
    summary = "a cable is drawn around four pegs into a figure 8; violation: its free end was drawn in"

    def control(self, frame: Frame, actions: Array) -> Array:
        # From where the gripper is, not from where it was told to be: what pulls at a taut cable does not wind up.
        gripper = _cable(frame)[:, 0]
        return project(gripper, np.clip(gripper + STEP * actions, -REACH, REACH))

    def observe(self, frame: Frame) -> Array:
        cable = _cable(frame)
        gripper = cable[:, 0]
        from_pegs = gripper[:, None] - PEGS
        return np.concatenate([gripper, from_pegs.reshape(-1, 8), cable[:, 1:].reshape(-1, 2 * (LINKS - 1))], axis=1)

    def success(self, frame: Frame) -> NDArray[np.bool_]:
        return figure_eight(_cable(frame)[:, ::-1])

    def violation(self, frame: Frame) -> NDArray[np.bool_]:
        cable = frame["xpos"][:, 2:]
        inside = (cable[..., :2] > TABLE[0]) & (cable[..., :2] < TABLE[1])
        on_table = inside.all(axis=2) & (np.abs(cable[..., 2] - 0.05) < 0.07)  # a push may toss it up a little
        drawn_in = (np.abs(cable[:, -1, :2]) < REACH).all(axis=1)
        return np.asarray(drawn_in | ~on_table.all(axis=1))

    def initial(self, rng: np.random.Generator, n: int, qpos0: Array, qvel0: Array) -> tuple[Array, Array]:
        qpos = np.tile(qpos0, (n, 1))
        qpos[:, :2] = START + rng.uniform(-0.003, 0.003, (n, 2))
        # About the same shape every time: a slight bow to one side, which is a little more or less, with small kinks.
        qpos[:, 2] = rng.uniform(-0.15, 0.15, n)
        qpos[:, 4::2] = rng.uniform(0.02, 0.06, (n, 1)) + 0.03 * rng.standard_normal((n, LINKS - 1))
        return qpos, np.tile(qvel0, (n, 1))


def project(start: Array, end: Array) -> Array:
    """The ends (N, 2), m, of steps, with those inside a logical obstacle moved to the nearest point of its border.

    None goes farther round than 60 degrees as seen from the peg: the gripper moves straight, past a peg and not over it, and
    from the border of an obstacle that is 1 cm.
    """
    for peg in PEGS:
        away, back = end - peg, _unit(start - peg)
        outward = _unit(away)
        cosine = (outward * back).sum(axis=1, keepdims=True)
        farthest = 0.5 * back + np.sqrt(0.75) * _unit(outward - cosine * back)
        outward = np.where(cosine < 0.5, farthest, outward)
        end = np.where(np.linalg.norm(away, axis=1, keepdims=True) < KEEP_OUT, peg + KEEP_OUT * outward, end)
    return end


def _unit(vectors: Array) -> Array:
    """Vectors (N, 2) of length 1; for those of length 0, which point nowhere, any direction will do."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-9, vectors / np.maximum(length, 1e-9), [1.0, 0.0])


def turns(path: Array) -> Array:
    """How often each path (N, P, 2) goes around each peg, counter-clockwise from its first point to its last, (N, 4)."""
    away = path[:, :, None] - PEGS
    bearing = np.arctan2(away[..., 1], away[..., 0])
    change = np.diff(bearing, axis=1)
    return ((change + np.pi) % (2 * np.pi) - np.pi).sum(axis=1) / (2 * np.pi)  # type: ignore[no-any-return]


def figure_eight(path: Array) -> NDArray[np.bool_]:
    """Whether each path (N, P, 2), m, from the free end to the gripper, is a figure 8 around the pegs, (N,).

    It goes at least once all around both upper pegs one way and at least once around both lower pegs the other way, and
    nowhere between the two pegs of a pair: each loop holds both of its pegs.
    """
    around = turns(path)
    upper, lower = around[:, _UPPER], around[:, _LOWER]
    whole = ((upper >= 1) & (lower <= -1)).all(axis=1) | ((upper <= -1) & (lower >= 1)).all(axis=1)
    return np.asarray(whole & ~splits(path[:, :-1], path[:, 1:]).any(axis=1))


def splits(start: Array, end: Array) -> NDArray[np.bool_]:
    """Whether straight lines from `start` to `end` (..., 2) pass between the two pegs of a pair, (...)."""
    found = np.zeros(np.broadcast_shapes(start.shape, end.shape)[:-1], dtype=bool)
    for left, right in (PEGS[_UPPER], PEGS[_LOWER]):
        x = _x_at(start, end, left[1])
        found |= (x > left[0]) & (x < right[0])
    return found


def _x_at(start: Array, end: Array, height: float) -> Array:
    """Where straight lines (..., 2) cross the height y, as x; NaN where they do not."""
    below, above = start[..., 1] - height, end[..., 1] - height
    crosses = (below < 0) != (above < 0)
    part = below / np.where(crosses, below - above, 1.0)
    return np.where(crosses, start[..., 0] + part * (end[..., 0] - start[..., 0]), np.nan)


def _cable(frame: Frame) -> Array:
    """The cable's joints (x, y), m, from the gripper to the free end, (N, 30, 2)."""
    return frame["xpos"][:, 2:, :2]
