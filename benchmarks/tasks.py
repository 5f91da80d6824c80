"""Robot steps a second of the tasks that only we have as fleets, and images a second of those that are seen from above."""

from __future__ import annotations

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
"""Timesteps of a round, by number of robots."""
TARGETS = {"Navigation": 200_000, "BlockPushing": 200_000, "ObstaclePushing": 200_000, "FrankaCubeStack": 8_000}
"""Robot steps a second with 100 robots on 4 cores; images: 5,000 a second."""


def run(quick: bool = False) -> dict[str, Any]:
    """Each number is a median over rounds in which all variants take turns, repeating what the task's human commanded."""
    names = [name for name in TASKS if name not in MUJOCO or MUJOCO[name].assets != GYMNASIUM]
    results = []
    for robots in STEPS:
        rows = []
        for task in names:
            rates = measure(task, robots, rounds=3 if quick else 7)
            rows.append([task, *(rates.get(n, "") for n in THREADS)])
            results.append({"task": task, "robots": robots, "steps a second": rates})
        head = [f"{robots} robots", *(f"{n} thr." for n in THREADS)]
        print(table(head, rows), "\n", flush=True)
    pictures = {task: images(task, rounds=3 if quick else 7) for task in names if task not in MUJOCO}
    print(table(["100 robots", "images a second, 1 thr."], [list(row) for row in pictures.items()]), "\n", flush=True)
    return {"tasks": results, "images a second": pictures, "targets": TARGETS}


def measure(task: str, robots: int, rounds: int) -> dict[int, float]:
    """Robot steps a second by number of threads; tasks without a simulator have one."""
    variants: dict[str, Callable[[], Any]] = {}
    begin: dict[str, Callable[[], Any]] = {}
    threads = [n for n in THREADS if n == 1 or (robots > 1 and task in MUJOCO)]
    fleets = {str(n): make_fleet(task, robots, disturbance="none", threads=n) for n in threads}
    actor = experts.load(task)[0]
    assert not isinstance(actor, GaussianActor)  # a program: nothing that torch does goes on while physics is timed
    episode = record(fleets["1"], actor, STEPS[robots])
    for name, fleet in fleets.items():
        variants[name] = lambda fleet=fleet: episode.play(fleet)
        begin[name] = lambda fleet=fleet: fleet.reset(seed=episode.seed)
    for name in variants:
        begin[name]()
        variants[name]()
    seconds = take_turns(variants, rounds, before=begin)
    for fleet in fleets.values():
        fleet.close()
    return {int(name): _rate(episode, took) for name, took in seconds.items()}


def images(task: str, rounds: int) -> float:
    """Images (64, 64, 3) a second, of 100 robots at once."""
    fleet = make_fleet(task, 100)
    assert isinstance(fleet, ArrayFleet)
    fleet.reset(seed=0)
    fleet.images()
    seconds = take_turns({"draw": lambda: [fleet.images() for _ in range(10)]}, rounds)
    return 1000 / float(np.median(seconds["draw"]))


def _rate(episode: Episode, took: list[float]) -> float:
    return episode.robot_steps / float(np.median(took))
