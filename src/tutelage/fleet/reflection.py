"""Symmetry of a robot: what its mirror images observe and do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class Reflection:
    """A mirror image of a robot: each of its numbers is one of the robot's own, perhaps with the other sign.

    Attributes:
        observation, observation_sign: (D,) int and float64: number k of its observation is `observation_sign[k]` times
            number `observation[k]` of the robot's.
        action, action_sign: (A,) likewise.
    """

    observation: Array
    observation_sign: Array
    action: Array
    action_sign: Array
