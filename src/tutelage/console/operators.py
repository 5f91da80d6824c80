"""What each person has done, and how fast the server was for them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

RECENT = 2000
"""Commands whose latency is remembered."""


@dataclass
class Operator:
    """Counts of one person; times in seconds."""

    interventions: int = 0
    resets: int = 0
    declined: int = 0
    commands: int = 0
    human_time: float = 0.0
    accepted: int = 0
    acceptance_time: float = 0.0
    latency: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))


class Operators:
    """The statistics of all persons. Call it with the lock of the offers."""

    def __init__(self) -> None:
        self._of: dict[str, Operator] = {}

    def __getitem__(self, name: str) -> Operator:
        return self._of.setdefault(name, Operator())

    def used(self, name: str, seconds: float) -> None:
        """A command was executed so long after it came."""
        operator = self[name]
        operator.commands += 1
        operator.latency.append(seconds)

    def rows(self, present: set[str], since: dict[str, float]) -> list[dict[str, Any]]:
        """As JSON values.

        acceptance_time: mean; latency: from a command's arrival to its execution, ms, which includes the wait for the next
        timestep.

        Args:
            present: who is here.
            since: for how long those who have a robot have had it, s.
        """
        return [
            {
                "operator": name,
                "present": name in present,
                "interventions": o.interventions,
                "resets": o.resets,
                "declined": o.declined,
                "commands": o.commands,
                "human_time": round(o.human_time + since.get(name, 0.0), 3),
                "acceptance_time": round(o.acceptance_time / o.accepted, 3) if o.accepted else None,
                "latency_p50_ms": _percentile(o.latency, 50),
                "latency_p99_ms": _percentile(o.latency, 99),
            }
            for name, o in sorted(self._of.items())
        ]

    def state_dict(self) -> dict[str, Any]:
        """The counts, as JSON values."""
        names = ("interventions", "resets", "declined", "commands", "human_time", "accepted", "acceptance_time")
        return {"rows": [[name, *(getattr(o, k) for k in names)] for name, o in self._of.items()]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self._of = {
            str(name): Operator(int(a), int(b), int(c), int(d), float(e), int(f), float(g))
            for name, a, b, c, d, e, f, g in state["rows"]
        }


def _percentile(values: deque[float], q: float) -> float | None:
    return round(1000 * float(np.percentile(np.array(values), q)), 2) if values else None
