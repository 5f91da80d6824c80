"""Allocation of a very large fleet, against one partial sort of as many numbers (the floor)."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.timing import ratio, table, take_turns
from tutelage.fleet.allocation import NOBODY, FleetDAgger
from tutelage.fleet.modes import Mode

SIZES = ((1_000_000, 10_000), (100, 10))


def run(quick: bool = False) -> dict[str, Any]:
    """Milliseconds of one allocation, by kind of priorities; half of the humans are busy with a robot."""
    results = [result for size in SIZES for result in measure(*size, rounds=7 if quick else 31)]
    rows = [[f"{r['robots']:,} x {r['humans']:,}: {r['ranks']}", r["milliseconds"], r["ratio"]] for r in results]
    print(table(["robots x humans: priorities", "ms", "/ np.partition"], rows))
    return {"allocation": results}


def measure(robots: int, humans: int, rounds: int) -> list[dict[str, Any]]:
    """One size of fleet."""
    repeats = 1 if robots > 10_000 else 200
    rng = np.random.Generator(np.random.PCG64(0))
    previous, mode, age = _assigned(robots, humans, rng)
    numbers, allocate = rng.random(robots), FleetDAgger()
    variants = {"np.partition": lambda: [np.partition(numbers, robots - humans) for _ in range(repeats)]}
    for kind, ranks in _priorities(robots, rng).items():
        variants[kind] = lambda ranks=ranks: [allocate(ranks, previous, mode, age, rng) for _ in range(repeats)]
    for work in variants.values():
        work()
    seconds = take_turns(variants, rounds)
    return [
        {"robots": robots, "humans": humans, "ranks": kind, "milliseconds": 1e3 * float(np.median(took)) / repeats,
         "ratio": ratio(seconds, kind, "np.partition")}
        for kind, took in seconds.items()
    ]  # fmt: skip


def _assigned(robots: int, humans: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Half of the humans teleoperate a robot, for 0 to 9 timesteps so far."""
    previous, mode = np.full(humans, NOBODY), np.full(robots, Mode.AUTONOMOUS, dtype=np.int8)
    busy = rng.permutation(humans)[: humans // 2]
    previous[busy] = rng.choice(robots, len(busy), replace=False)
    mode[previous[busy]] = Mode.TELEOPERATED
    return previous, mode, rng.integers(0, 10, robots)


def _priorities(n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """(N, 3) each, column by column in memory as priorities are."""

    def cur(fallen: float) -> np.ndarray:
        violation = rng.random(n) < fallen
        sparse = [np.where((rng.random(n) < share) & ~violation, rng.random(n), 0.0) for share in (0.1, 0.01)]
        return np.array([violation, *sparse]).T

    return {
        "C.U.R., 5 % violated": cur(0.05),
        "C.U.R., 0.5 % violated": cur(0.005),
        "C.U.R., nobody violated": cur(0.0),
        "three continuous columns": rng.random((3, n)).T,
    }
