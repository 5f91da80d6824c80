"""Robot steps a second of the tasks that only we have as fleets, and images a second of those that are seen from above."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.timing import table, take_turns
from tutelage.envs import experts
from tutelage.envs.array_fleet import ArrayFleet
from tutelage.envs.registry import make_fleet
from tutelage.envs.speed import Episode, record
from tutelage.envs.tasks import MUJOCO, TASKS
from tutelage.envs.tasks.base import GYMNASIUM
from tutelage.policies.expert import GaussianActor

STEPS, THREADS = {1: 150, 100: 60, 1000: 15}, (1, 2, 4)
"""Timesteps of a round by number of robots, at most; and threads, of tasks on the physics engine."""
ROUND, TASK = 0.5, 9.0
"""Seconds of a round of one thread, and of all rounds of a task, about: what is slow makes fewer timesteps."""
SLOW = 1.5
"""A fleet whose timestep takes longer than this, in seconds, is left out."""
TARGETS = {
    "Anymal": 8_000, "Navigation": 200_000, "BlockPushing": 200_000, "ObstaclePushing": 200_000, "FrankaCubeStack": 8_000,
    "AllegroHand": 4_000,
}  # fmt: skip
"""Robot steps a second with 100 robots on 4 cores."""
IMAGES, PUSHING = 5_000, ("BlockPushing", "ObstaclePushing")
"""Target of images a second, and of which tasks."""


def run(quick: bool = False) -> dict[str, Any]:
    """Each number is a median over rounds in which all variants take turns, repeating what the task's human commanded."""
    names = [name for name in TASKS if name not in MUJOCO or MUJOCO[name].assets != GYMNASIUM]
    results = []
    for robots in STEPS:
        for task in names:
            began = time.perf_counter()
            rates = measure(task, robots, 3 if quick else 7)
            results.append({"task": task, "robots": robots, "steps a second": {str(n): rate for n, rate in rates.items()}})
            print(f"{task}, {robots} robots: {rates} ({time.perf_counter() - began:.0f} s)", flush=True)
    pictures = {task: images(task, rounds=3 if quick else 7) for task in names if task not in MUJOCO}
    found = {"tasks": results, "images a second": pictures, "targets": TARGETS, "target of images": IMAGES}
    print("\n" + page(found), flush=True)
    return found


def page(result: dict[str, Any]) -> str:
    """The tables of docs/benchmarks.md."""
    parts = []
    for robots in STEPS:
        rows = []
        for found in (r for r in result["tasks"] if r["robots"] == robots):
            rates = found["steps a second"]
            row = [found["task"], *(round(rates[str(n)]) if str(n) in rates else "" for n in THREADS)]
            if robots == 100:
                row += _verdict(max(rates.values(), default=0.0), result["targets"].get(found["task"]))
            rows.append([f"{x:,}" if isinstance(x, int) else x for x in row])
        head = [
            f"{robots} robot{'s' if robots > 1 else ''}",
            *(f"{n} thr." for n in THREADS),
            *(["target", "reached"] if robots == 100 else []),
        ]
        parts.append(table(head, rows))
    rows = []
    for task, rate in result["images a second"].items():
        target = result["target of images"] if task in PUSHING else None
        rows.append([task, f"{rate:,.0f}", *_verdict(rate, target)])
    parts.append(table(["100 robots", "images a second, 1 thr.", "target", "reached"], rows))
    return "\n\n".join(parts)


def _verdict(rate: float, target: float | None) -> list[str]:
    return ["", ""] if target is None else [f"{target:,}", "yes" if rate >= target else "**no**"]


def measure(task: str, robots: int, rounds: int) -> dict[int, float]:
    """Robot steps a second by number of threads; tasks without a simulator have one. Empty for a fleet that is too slow."""
    threads = [n for n in THREADS if n == 1 or (robots > 1 and task in MUJOCO)]
    fleets = {str(n): make_fleet(task, robots, disturbance="none", threads=n) for n in threads}
    actor = experts.load(task)[0]
    assert not isinstance(actor, GaussianActor)  # a program: nothing that torch does goes on while physics is timed
    trial = record(fleets["1"], actor, 2)  # also compiles what is not yet
    seconds = _seconds(lambda: trial.play(fleets["1"])) / 2
    found: dict[int, float] = {}
    if seconds < SLOW:
        steps = int(np.clip(ROUND / seconds, 2, STEPS[robots]))
        episode = record(fleets["1"], actor, steps)
        variants: dict[str, Callable[[], Any]] = {}
        begin: dict[str, Callable[[], Any]] = {}
        for name, fleet in fleets.items():
            variants[name] = lambda fleet=fleet: episode.play(fleet)
            begin[name] = lambda fleet=fleet: fleet.reset(seed=episode.seed)
        for name in variants:
            begin[name]()
            variants[name]()
        rounds = int(np.clip(TASK / (len(variants) * steps * seconds), 2, rounds))
        found = {int(name): _rate(episode, took) for name, took in take_turns(variants, rounds, before=begin).items()}
    for fleet in fleets.values():
        fleet.close()
    return found


def images(task: str, rounds: int) -> float:
    """Images (64, 64, 3) a second, of 100 robots at once."""
    fleet = make_fleet(task, 100)
    assert isinstance(fleet, ArrayFleet)
    fleet.reset(seed=0)
    fleet.images()
    seconds = take_turns({"draw": lambda: [fleet.images() for _ in range(10)]}, rounds)
    return 1000 / float(np.median(seconds["draw"]))


def _seconds(work: Callable[[], Any]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def _rate(episode: Episode, took: list[float]) -> float:
    return episode.robot_steps / float(np.median(took))
