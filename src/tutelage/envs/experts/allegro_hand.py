"""The algorithmic human for AllegroHand: two gaits of the fingers, one for each way in which the cube can be turned.

Each is a periodic motion of all joints, found by `tutelage.envs.experts.gait_search`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tutelage.envs.tasks.allegro_hand import REST, SCALE
from tutelage.envs.tasks.base import Array

FILE = Path(__file__).with_name("allegro_hand_gaits.json")
SIDES = {"left": 1.0, "right": -1.0}
"""The way in which a gait turns the cube, as seen from above, and its sign."""
CYCLE = 16
"""Timesteps of a period."""
HARMONICS = 2
RATE = 0.25
"""Largest change of an action in a timestep. From one gait to the other fingers go gently, or they throw the cube out."""
FEATURES = 6
"""How many numbers about the cube a gait heeds."""
_ROWS = 1 + 2 * HARMONICS + FEATURES
_PHASES = 2 * np.pi * np.arange(CYCLE) / CYCLE
BASIS = np.concatenate([[np.cos(h * _PHASES), np.sin(h * _PHASES)] for h in range(1, HARMONICS + 1)])
"""Cosines and sines of the period, of half the period, and so on, (2 `HARMONICS`, `CYCLE`)."""


@dataclass(frozen=True)
class Gait:
    """A periodic motion of the joints, in actions, and how it heeds the cube.

    Attributes:
        numbers: (1 + 2 `HARMONICS` + `FEATURES`, 16): the mean of each joint, the amplitudes of `BASIS`, and what is added
            for each of `features`.
    """

    numbers: Array

    @property
    def period(self) -> Array:
        """(`CYCLE`, 16), before the cube is heeded."""
        return self.numbers[0] + BASIS.T @ self.numbers[1 : 1 + 2 * HARMONICS]  # type: ignore[no-any-return]

    @property
    def feedback(self) -> Array:
        """(`FEATURES`, 16)."""
        return self.numbers[1 + 2 * HARMONICS :]

    @classmethod
    def of(cls, numbers: Any) -> Gait:
        """The gait that so many numbers describe, row by row."""
        return cls(np.asarray(numbers, dtype=np.float64).reshape(_ROWS, 16))


def features(place: Array, turn: Array) -> Array:
    """What a gait heeds, (N, `FEATURES`), of cubes at places (N, 3), m, turned by quaternions (N, 4).

    How far the cube is from the middle of the hand, in units of 5 cm; which way its upper face leans; and how its edges lie:
    cosine and sine of four times its yaw.
    """
    w, x, y, z = turn.T
    yaw = 2 * np.arctan2(z, w)
    lean = np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x)])
    return np.column_stack([20 * (place - REST)[:, :2], lean, np.cos(4 * yaw), np.sin(4 * yaw)])


def follow(period: Array, feedback: Array, heeded: Array, previous: Array) -> Array:
    """The actions (N, 16) of each gait that come after the previous actions, or as far towards them as `RATE` allows.

    Args:
        period, feedback: (N, `CYCLE`, 16) and (N, `FEATURES`, 16) of the gaits.
        heeded: (N, `FEATURES`) what `features` says about the cubes.
        previous: (N, 16).
    """
    choices = (period + np.einsum("nf,nfj->nj", heeded, feedback)[:, None]).clip(-1, 1)
    now = np.square(choices - previous[:, None]).sum(axis=2).argmin(axis=1)
    change = choices[np.arange(len(choices)), (now + 1) % CYCLE] - previous
    return previous + change.clip(-RATE, RATE)  # type: ignore[no-any-return]


def shipped() -> dict[str, Gait]:
    """The gaits that were found, by `SIDES`."""
    found: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
    return {side: Gait.of(found[side]["numbers"]) for side in SIDES}


class Turner:
    """Turns the cube the shorter way round to its goal.

    It keeps no memory, so it can take over in any state: the phase of its gait is in the previous action, a part of an
    observation. It takes the phase whose action is nearest to that, and does what comes next.
    """

    def __init__(self) -> None:
        gaits = shipped()
        self._period = np.stack([gaits[side].period for side in SIDES])  # (2, K, 16)
        self._feedback = np.stack([gaits[side].feedback for side in SIDES])

    def act(self, obs: Array) -> Array:
        """Actions (N, 16) float32 for observations (N, 88)."""
        state = np.asarray(obs, dtype=np.float64) / SCALE
        scalar, vertical = state[:, 68], state[:, 71]  # of the turn from the goal to the cube
        beyond = (2 * np.arctan2(vertical, scalar) + np.pi) % (2 * np.pi) - np.pi
        side = (beyond > 0).astype(np.intp)
        heeded = features(state[:, 48:51], state[:, 51:55])
        return follow(self._period[side], self._feedback[side], heeded, state[:, 72:88]).astype(np.float32)
