"""Which human helps which robot: the allocation policy omega of Fleet-DAgger (algorithm 4, eq. 5.1)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.modes import Mode

Array = NDArray[Any]
NOBODY = -1


class FleetDAgger:
    """Algorithm 4: keep interventions until their minimum time, then give free humans to the highest priorities.

    Args:
        t_teleop: t_T, minimum timesteps of a teleoperation.
        t_reset: t_R, timesteps of a hard reset.
    """

    def __init__(self, t_teleop: int = 5, t_reset: int = 5) -> None:
        for name, value in (("t_teleop (t_T)", t_teleop), ("t_reset (t_R)", t_reset)):
            if value < 1:
                raise ConfigError(f"{name} must be at least 1 timestep, got {value}")
        self.t_teleop, self.t_reset = t_teleop, t_reset

    def __call__(self, ranks: Array, previous: Array, mode: Array, age: Array, rng: np.random.Generator) -> Array:
        """The robot of each human during the coming step, (M,) int, or `NOBODY`: a one-to-one partial matching.

        A human whose minimum time is over competes for the best robots like a free one, but stays with the present
        robot if that is among them.

        Args:
            ranks: (N, K) priorities, compared lexicographically; a robot whose K numbers are all <= 0 needs nobody.
            previous: (M,) the robot of each human during the last step, or `NOBODY`.
            mode: (N,) the mode of each robot.
            age: (N,) timesteps that each robot has been in its mode.
            rng: breaks ties between equal priorities.

        Raises:
            ContractError: a priority is NaN.
        """
        robots = np.where(self.locked(previous, mode, age), previous, NOBODY)
        (free,) = np.nonzero(robots == NOBODY)
        wanted = highest(ranks, len(free), exclude=robots[robots != NOBODY], rng=rng)

        # Lines 7-10 fell through, yet the robot is still among the best.
        needs = np.zeros(len(ranks), dtype=bool)
        needs[wanted] = True
        stays = free[(previous[free] != NOBODY) & needs[previous[free]]]
        robots[stays] = previous[stays]
        needs[previous[stays]] = False
        others = wanted[needs[wanted]]
        movers = free[robots[free] == NOBODY][: len(others)]  # lines 15-17
        robots[movers] = others
        return robots

    def locked(self, previous: Array, mode: Array, age: Array) -> Array:
        """Which humans must stay where they are, (M,) bool (lines 4-10)."""
        robot = np.maximum(previous, 0)
        kind, time = mode[robot], age[robot]
        busy = (
            (kind == Mode.SWITCHING)
            | ((kind == Mode.RESETTING) & (time < self.t_reset))
            | ((kind == Mode.TELEOPERATED) & (time < self.t_teleop))
        )
        return np.asarray((previous != NOBODY) & busy)

    def state_dict(self) -> dict[str, Any]:
        """What it remembers between timesteps: nothing."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""


class FirstComeFirstServed(FleetDAgger):
    """Algorithm 4 with a queue in place of priorities: who has needed somebody for longest is next (appendix B.4).

    A robot that has a human stays first for as long as it needs one, so nobody is called away.
    """

    def __init__(self, t_teleop: int = 5, t_reset: int = 5) -> None:
        super().__init__(t_teleop, t_reset)
        self.needed: Array = np.zeros(0)

    def __call__(self, ranks: Array, previous: Array, mode: Array, age: Array, rng: np.random.Generator) -> Array:
        needy = (ranks > 0).any(axis=1)
        self.needed = np.where(needy, 1.0 + (self.needed if len(self.needed) else 0.0), 0.0)
        return super().__call__(self.needed[:, None], previous, mode, age, rng)

    def state_dict(self) -> dict[str, Any]:
        """For how many timesteps each robot has needed somebody."""
        return {"needed": self.needed.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.needed = state["needed"].copy()


def highest(ranks: Array, k: int, exclude: Array, rng: np.random.Generator) -> Array:
    """The at most k robots of highest positive priority that are not in `exclude`, from highest to lowest (line 13).

    Column by column: a partial sort finds the k-th largest value; robots above it are in, robots equal to it are decided
    by the next column, and at last by a random number, so no robot is preferred for its index. O(N), not O(N log N).
    """
    columns = [ranks[:, c] for c in range(ranks.shape[1])]
    if any(math.isnan(column @ column) for column in columns):  # a sum of squares is NaN where any number is, and only there
        raise ContractError(f"the priority of robot {int(np.argmax(np.isnan(ranks).any(axis=1)))} is NaN")
    tied = np.empty(0, dtype=np.int64)
    for reach in (_reach(columns[0], k), 0.0):
        if reach > 0:  # at least k robots with so high a first number: the others have no chance
            eligible = columns[0] >= reach
        else:
            eligible = columns[0] > 0
            for column in columns[1:]:
                eligible |= column > 0
        eligible[exclude] = False
        tied = np.flatnonzero(eligible)
        if len(tied) >= k or reach <= 0:
            break
    chosen: list[Array] = []
    for column in columns:
        if len(tied) <= k or k == 0:
            break
        values = column[tied]
        cut = _kth_largest(values, k)
        above = tied[np.flatnonzero(values > cut)]
        chosen.append(above)
        k -= len(above)
        tied = tied[np.flatnonzero(values == cut)]
    if len(tied) > k:
        tied = rng.choice(tied, k, replace=False)
    chosen.append(tied)
    lots, drawn = rng.random(sum(map(len, chosen))), 0
    ordered = [np.empty(0, dtype=np.int64)]
    for c, robots in enumerate(chosen):  # column c decided about them, as they are equal in the columns before
        if len(robots):
            robots = robots[np.argsort(lots[drawn : drawn + len(robots)])]
            drawn += len(robots)
            keys = [column[robots] for column in reversed(columns[c:])]
            ordered.append((robots[np.lexsort(keys)] if keys else robots)[::-1])
    return np.concatenate(ordered)


def _reach(values: Array, k: int) -> float:
    """A value that about 2 k robots reach, judged from a sample; 0 where that says little.

    With it, columns of a million numbers are read once and not copied.
    """
    stride = max(1, len(values) // 2**14)
    sample, rank = values[::stride], 2 * k // stride + 8
    return float(np.partition(sample, -rank)[-rank]) if stride > 1 and rank < len(sample) else 0.0


def _kth_largest(values: Array, k: int) -> Any:
    """The k-th largest of at least k values (n,).

    The lowest value is taken out first: many robots share it (0, where a term has nothing to say), and a partial sort of
    equal values takes ten times longer.
    """
    low = values.min()
    rest = values[np.flatnonzero(values > low)]
    return np.partition(rest, -k)[-k] if len(rest) >= k else low
