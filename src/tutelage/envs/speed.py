"""How many timesteps of a robot a fleet makes in a second, on this machine."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.fleet.fleet import Fleet
from tutelage.fleet.policy import Policy

Array = NDArray[Any]


@dataclass(frozen=True)
class Episode:
    """What was commanded in the first timesteps after `reset(seed=seed)`, to be repeated while a clock runs.

    Attributes:
        seed: of the reset.
        actions: (T, N, A).
        again: (T, N) bool, the robots that were reset after each timestep, because they were done or in violation.
    """

    seed: int
    actions: Array
    again: Array

    @property
    def robot_steps(self) -> int:
        """T N."""
        return self.again.size

    def play(self, fleet: Fleet) -> None:
        """Repeat it, after a reset with its seed: physics and resets, without a policy."""
        for actions, again in zip(self.actions, self.again, strict=True):
            fleet.step(actions)
            if again.any():
                fleet.reset(options={"reset_mask": again})


def record(fleet: Fleet, policy: Policy | None, steps: int, seed: int = 0) -> Episode:
    """Drive all robots for some timesteps with a policy, or with random actions within 30 % of their bounds."""
    rng = np.random.Generator(np.random.PCG64(seed))
    low, high = 0.3 * fleet.action_low, 0.3 * fleet.action_high
    obs, info = fleet.reset(seed=seed)
    done, over = [], []
    for _ in range(steps):
        if policy is None:
            actions = rng.uniform(low, high, (fleet.num_envs, len(low))).astype(np.float32)
        else:
            actions = np.asarray(policy.act(info.get("state", obs)))
        obs, _, _, truncated, info = fleet.step(actions)
        again = info["violation"] | info["success"] | truncated
        done.append(actions)
        over.append(again)
        if again.any():
            obs, info = fleet.reset(options={"reset_mask": again})
    return Episode(seed, np.stack(done), np.stack(over))


def steps_a_second(fleet: Fleet, policy: Policy | None = None, seconds: float = 1.0) -> float:
    """Timesteps of a robot a second, over about so many seconds: recorded first, then repeated without the policy."""
    episode = record(fleet, policy, 20)
    took, count = 0.0, 0
    while took < seconds:
        fleet.reset(seed=episode.seed)
        start = time.perf_counter()
        episode.play(fleet)
        took += time.perf_counter() - start
        count += episode.robot_steps
    return count / took
