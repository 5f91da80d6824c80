"""One episode of a policy on every robot of a fleet, without help and without learning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.fleet.fleet import Fleet
from tutelage.fleet.policy import Policy

Array = NDArray[Any]


@dataclass(frozen=True)
class Episodes:
    """What became of N episodes.

    Attributes:
        returns: (N,) float64, the sum of the rewards until the episode ended.
        survived: (N,) bool, no violation.
        succeeded: (N,) bool.
    """

    returns: Array
    survived: Array
    succeeded: Array


def rollout(fleet: Fleet, policy: Policy, seed: int) -> Episodes:
    """Reset all robots with the seed, and let the policy act until every episode has ended."""
    obs, info = fleet.reset(seed=seed)
    total, running = np.zeros(fleet.num_envs), np.ones(fleet.num_envs, dtype=bool)
    fallen, succeeded = info["violation"].copy(), np.zeros(fleet.num_envs, dtype=bool)
    for _ in range(fleet.horizon):
        obs, reward, _, truncated, info = fleet.step(policy.act(obs))
        total += np.where(running, reward, 0.0)
        fallen |= running & info["violation"]
        succeeded |= running & info["success"] & ~info["violation"]
        running &= ~(info["violation"] | info["success"] | truncated)
        if not running.any():
            break
    return Episodes(total, ~fallen, succeeded)
