"""AllegroHand: four fingers turn a cube in the hand to orientations; violation: the cube was dropped.

The AllegroHand task of the IFL Benchmark (section 5.6 of the dissertation) on our own model, with the published
dimensions of the Allegro Hand.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array, Frame, GoalTask

RANGE = np.array(
    [
        *[[-0.47, 0.47], [-0.196, 1.61], [-0.174, 1.709], [-0.227, 1.618]] * 3,
        *[[0.263, 1.396], [-0.105, 1.163], [-0.189, 1.644], [-0.162, 1.719]],
    ]
).T
"""Least and greatest joint angles, rad, (2, 16): four joints each of index, middle and ring finger and of the thumb."""
HOME = np.array([*[0.0, 0.9, 0.7, 0.6] * 3, 1.3, 0.3, 0.3, 0.3])
"""Joint angles at the start, rad: the fingers stand around the cube."""
REST = np.array([-0.03, 0.0, 0.0361])
"""Where the cube lies at the start, m."""
TOLERANCE = 0.2
"""A cube that is turned no farther than this from its goal has reached it, rad."""
APART = 0.5
"""A new goal is at least so far from where the cube is, rad."""
DROPPED = 0.15
"""A cube that is farther than this from `REST` is out of the hand, m."""
SCALE = np.concatenate([np.ones(16), np.full(16, 0.2), np.full(16, 10.0), np.ones(10), np.full(3, 0.2), np.ones(27)])
"""(88,) factors that bring observations to the order of 1."""

_JOINTS, _CUBE, _CUBE_TURN, _GOAL = slice(0, 16), slice(16, 19), slice(19, 23), slice(23, 27)


class AllegroHand(GoalTask):
    """88 observations, 16 actions.

    Observations, times `SCALE`: joint angles, from -1 to 1 over their ranges (16); joint velocities (16, rad/s); torques of
    the motors (16, N m); position of the cube (3, m) and its orientation (quaternion, 4), its velocity (3, m/s) and angular
    velocity (3, rad/s); position (3, m) and orientation (4) of the goal; the turn from the goal to the cube (quaternion, 4);
    the previous actions (16).

    Actions in [-1, 1] are position targets of the joints over their ranges, 20 times a second. Violation: the cube is out of
    the hand. Goal: the cube is turned as it should be, within `TOLERANCE`. Then comes the next one, and the hand goes on.
    """

    name, xml, frame_skip = "AllegroHand", "allegro_hand.xml", 5
    assets = Path(__file__).parent / "assets"
    fields = ("qpos", "qvel", "ctrl", "actuator_force")
    push_body, camera = "cube", "fixed"
    horizon = 600
    goes_on = True
    disturbance = "mild"
    offline_pairs = 1000
    initial_period = 2500
    action_low, action_high = (-np.ones(16, dtype=np.float32), np.ones(16, dtype=np.float32))
    expert = "tutelage.envs.experts.allegro_hand:Turner"
    summary = "a hand of four fingers turns a cube about the vertical to goals; violation: cube dropped"

    def control(self, frame: Frame, actions: Array) -> Array:
        low, high = RANGE
        return low + (high - low) * (actions + 1) / 2  # type: ignore[no-any-return]

    def observe(self, frame: Frame) -> Array:
        q, v = frame["qpos"], frame["qvel"]
        parts = [
            _of_range(q[:, _JOINTS]),
            v[:, :16],
            frame["actuator_force"],
            q[:, _CUBE],
            _upper(q[:, _CUBE_TURN]),
            v[:, 16:22],
            np.tile(REST, (len(q), 1)),
            _upper(q[:, _GOAL]),
            _upper(turn_between(q[:, _GOAL], q[:, _CUBE_TURN])),
            _of_range(frame["ctrl"]).clip(-1, 1),
        ]
        return np.concatenate(parts, axis=1) * SCALE  # type: ignore[no-any-return]

    def reward(self, frame: Frame, velocity: Array, actions: Array) -> Array:
        """More the nearer the cube is to its orientation and its place, less for large actions; 250 for a goal."""
        away = np.linalg.norm(frame["qpos"][:, _CUBE] - REST, axis=1)
        cost = 10.0 * away + 0.0002 * np.square(actions).sum(axis=1)
        return np.where(self.success(frame), 250.0, 0.0) + 1.0 / (self.angle(frame) + 0.1) - cost  # type: ignore[no-any-return]

    def success(self, frame: Frame) -> NDArray[np.bool_]:
        return np.asarray(self.angle(frame) <= TOLERANCE)

    def angle(self, frame: Frame) -> Array:
        """How far each cube is turned from its goal, (N,), rad."""
        turn = turn_between(frame["qpos"][:, _GOAL], frame["qpos"][:, _CUBE_TURN])
        return 2 * np.arctan2(np.linalg.norm(turn[:, 1:], axis=1), np.abs(turn[:, 0]))  # type: ignore[no-any-return]

    def violation(self, frame: Frame) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(frame["qpos"][:, _CUBE] - REST, axis=1) > DROPPED)

    def initial(self, rng: np.random.Generator, n: int, qpos0: Array, qvel0: Array) -> tuple[Array, Array]:
        qpos = np.tile(qpos0, (n, 1))
        qpos[:, _JOINTS] = (HOME + rng.uniform(-0.05, 0.05, (n, 16))).clip(*RANGE)
        qpos[:, _CUBE] = REST + rng.uniform(-0.005, 0.005, (n, 3)) * [1, 1, 0]
        yaw = rng.uniform(-np.pi, np.pi, n)
        qpos[:, _CUBE_TURN] = about_vertical(yaw)
        qpos[:, _GOAL] = about_vertical(yaw + _another(rng, n))
        return qpos, np.tile(qvel0, (n, 1))

    def onward(self, rng: np.random.Generator, qpos: Array) -> Array:
        """Another goal about the vertical, from wherever the cube is; all else stays as it is."""
        after, turn = qpos.copy(), qpos[:, _CUBE_TURN]
        yaw = 2 * np.arctan2(turn[:, 3], turn[:, 0])
        after[:, _GOAL] = about_vertical(yaw + _another(rng, len(qpos)))
        return after


def about_vertical(angle: Array) -> Array:
    """Unit quaternions (N, 4) of turns about the vertical by angles (N,), rad."""
    zero = np.zeros(len(angle))
    return np.column_stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)])


def turn_between(one: Array, other: Array) -> Array:
    """Unit quaternions (N, 4): the turn, in the world, that takes orientations `one` (N, 4) to `other` (N, 4)."""
    (a, b), (u, v) = (other[:, 0], one[:, 0]), (other[:, 1:], -one[:, 1:])
    scalar = a * b - (u * v).sum(axis=1)
    return np.column_stack([scalar, a[:, None] * v + b[:, None] * u + np.cross(u, v)])


def _another(rng: np.random.Generator, n: int) -> Array:
    """Angles from a cube to its next goal, (n,), rad."""
    return rng.uniform(APART, np.pi, n) * rng.choice([-1.0, 1.0], n)  # type: ignore[no-any-return]


def _of_range(angles: Array) -> Array:
    """Angles (N, 16), rad, as parts of the joints' ranges, from -1 to 1."""
    low, high = RANGE
    return 2 * (angles - low) / (high - low) - 1  # type: ignore[no-any-return]


def _upper(quaternions: Array) -> Array:
    """Of the two quaternions (N, 4) of each orientation, the one whose scalar part is not negative."""
    return np.where(quaternions[:, :1] < 0, -quaternions, quaternions)
