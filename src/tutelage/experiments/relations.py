"""The dissertation's statements about the algorithms, and what our runs say about them (section 5.6, appendix C)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tutelage.experiments.results import ONLINE, OURS, Column, Groups

NEAR_EXPERT = 0.8
"""A frozen policy approaches the expert when it completes this fraction of the expert's tasks."""
LITTLE_IDLE = 0.01
"""Idle time counts as eliminated below this fraction of all robot time."""


class Relation(NamedTuple):
    """A statement of the dissertation, and what our data say about it."""

    statement: str
    holds: bool
    numbers: str

    @property
    def verdict(self) -> str:
        """In capitals, for a reader who skims."""
        return "HOLDS" if self.holds else "DOES NOT HOLD"


def relations(groups: Groups) -> list[Relation]:
    """Section 5.6 and appendix C.3: those statements that the runs at hand can be asked about."""
    if OURS not in groups or len(groups) < 2:
        return []
    found = [
        _leads(groups, ONLINE[0], "C.U.R. has the most cumulative successes"),
        _leads(groups, ONLINE[4], "C.U.R. has the highest ROHE"),
        _leads(groups, ONLINE[1], "C.U.R. has fewer hard resets than the baselines"),
        *(_idle(groups, name) for name in ("U.C.", OURS) if name in groups),
    ]
    ours, expert = groups[OURS].mean("successes", "evaluation"), groups[OURS].mean("successes", "expert")
    if math.isfinite(ours) and math.isfinite(expert):
        fraction = ours / expert if expert else math.nan
        found.append(
            Relation(
                f"Frozen, C.U.R. approaches the expert (at least {NEAR_EXPERT:.0%} of its successes)",
                fraction >= NEAR_EXPERT,
                f"{ours:,.1f} of {expert:,.1f}, {fraction:.0%}",
            )
        )
    return found


def ablation_relations(groups: Groups) -> list[Relation]:
    """Appendix C.4: C.U.R. against its ablations."""
    if OURS not in groups or len(groups) < 2:
        return []
    return [
        _leads(groups, ONLINE[4], "C.U.R. has a higher ROHE than every ablation"),
        _leads(groups, ONLINE[0], "C.U.R. has more cumulative successes than every ablation"),
    ]


def _leads(groups: Groups, column: Column, statement: str) -> Relation:
    """Is the mean of C.U.R. strictly better than that of every other algorithm?"""
    ours = groups[OURS]
    others = [group for group in groups.values() if group is not ours]
    rival = max(others, key=lambda g: column.better * g.mean(column.metric))
    lead = column.better * (ours.mean(column.metric) - rival.mean(column.metric))
    numbers = f"{ours.text(column)}; best other: {rival.title} {rival.text(column)}"
    spread = float(ours.values(column.metric).std() + rival.values(column.metric).std())
    if min(len(ours.results), len(rival.results)) > 1 and abs(lead) <= spread:
        numbers += "; the standard deviations overlap"
    return Relation(statement, lead > 0, numbers)


def _idle(groups: Groups, name: str) -> Relation:
    """How much of the robots' time after the initial period of C.U.R. was spent idle?"""
    begin = groups[OURS].config["thresholds"]["initial"] or 0
    shares, waits = [], []
    for result in groups[name].results:
        curves, c = result["curves"], result["config"]
        t = np.array(curves["t"])
        k = int(np.searchsorted(t, begin))  # the first recorded timestep at or after the end of the period
        if k >= len(t) - 1:
            continue
        robot_time = c["robots"] * (t[-1] - t[k])
        idle = curves["idle_time"][-1] - curves["idle_time"][k]
        resetting = c["t_reset"] * (curves["hard_resets"][-1] - curves["hard_resets"][k])
        shares.append(idle / robot_time)
        waits.append(max(0.0, idle - resetting) / robot_time)
    share, wait = (float(np.mean(x)) if x else math.nan for x in (shares, waits))
    return Relation(
        f"{name} eliminates idle time after the initial period (below {LITTLE_IDLE:.0%} of robot time)",
        share < LITTLE_IDLE,
        f"{share:.2%} of robot time idle after timestep {begin:,}, of which {wait:.2%} waiting for a human",
    )
