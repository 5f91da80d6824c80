"""Round trips at four sizes and floods of 1000-byte messages on loopback.

All stacks are up at the same time and take turns, round after round, so a busy machine loads all of them alike; what counts
are ratios.
"""

from __future__ import annotations

import os
import statistics
from collections import deque
from itertools import chain
from typing import Any

from benchmarks.connectivity.pair import pairs
from benchmarks.connectivity.stacks import STACKS

SIZES = {"64 B": 64, "8 KB": 8 << 10, "256 KB": 256 << 10, "14 MB": 14 << 20}
TRIPS = {"64 B": 40, "8 KB": 40, "256 KB": 10, "14 MB": 3}
TURNS = {"64 B": 5, "8 KB": 5, "256 KB": 3, "14 MB": 1}
"""Round trips when it is a stack's turn, and turns in a round; of chains, whose lone messages wait for their anchors, a
tenth of the trips, but three. Turns are short, so that all stacks meet the machine in the same state, and there are many, as
other programs on the same processor make the ratio of two stacks differ from one turn to the next."""

WARM_UP = 300
"""Round trips of 256 KB, and two of 14 MB, before the first round. By then a publisher's history is full (64 MiB), as it is
in all but the first moments of its life, and glibc keeps what is freed: no message waits for the system to find memory."""


def measure(quick: bool = False, stacks: tuple[str, ...] = STACKS) -> dict[str, Any]:
    """Medians; and medians of ratios, to Zenoh with mutual TLS (round trips), to Cyclone and rosbridge (rates)."""
    rounds, flood = (2, 0.5) if quick else (15, 0.7)
    middle: dict[str, dict[str, list[float]]] = {name: {size: [] for size in SIZES} for name in stacks}
    rates: dict[str, list[float]] = {name: [] for name in stacks}
    with pairs(stacks) as made:
        for pair in made.values():
            for size in ["256 KB"] * (WARM_UP // (10 if quick else 1)) + ["14 MB"] * 2:
                pair.round_trip(os.urandom(SIZES[size]))
        order = deque(stacks)
        for _ in range(rounds):
            for size in chain.from_iterable([size] * turns for size, turns in TURNS.items()):
                order.rotate(-1)
                for name in order:
                    trips = max(3, TRIPS[size] // (10 if name == "chain" else 1))
                    taken = [made[name].round_trip(os.urandom(SIZES[size])) for _ in range(trips)]
                    middle[name][size].append(statistics.median(taken))
            for name in order:
                rates[name].append(made[name].flood(flood))
    return {
        "rounds": rounds,
        "round_trips_and_rates": [
            {
                "stack": name,
                **{f"{size} ms": 1e3 * statistics.median(middle[name][size]) for size in SIZES},
                "messages/s": statistics.median(rates[name]),
            }
            for name in stacks
        ],
        "ratios": [
            {
                "stack": name,
                **{f"{size} / zenoh mtls": _ratio(middle[name][size], middle["zenoh mtls"][size]) for size in SIZES},
                **{f"rate / {other}": _ratio(rates[name], rates[other]) for other in ("cyclone", "rosbridge")},
            }
            for name in stacks
        ],
    }


def _ratio(ours: list[float], theirs: list[float]) -> float:
    return statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
