"""Environment steps a second: our engine, Gymnasium's SyncVectorEnv, and MuJoCo with no task code around it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mujoco
import mujoco.rollout
import numpy as np
from gymnasium.vector import SyncVectorEnv

from benchmarks.timing import table, take_turns
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.tasks import MUJOCO
from tutelage.envs.tasks.base import GYMNASIUM

STEPS, THREADS = {1: 50, 100: 20, 1000: 5}, (1, 2, 4)
"""Timesteps of a round, by number of robots."""
LARGEST_SYNC = 100
"""Robots beyond which SyncVectorEnv is left out: it takes as long for each of them, and minutes to make."""
OWN = ("Anymal",)
"""Tasks on models of our own: nobody else has them, so there is no SyncVectorEnv to compare with."""
SCALE = 0.3
"""Actions are uniform within this fraction of their bounds, the same for all variants."""


def run(quick: bool = False) -> dict[str, Any]:
    """Each number is a median over rounds in which all variants take turns; all robots stand upright at their start."""
    results = []
    for robots in STEPS:
        for tasks in ([name for name, task in MUJOCO.items() if task.assets == GYMNASIUM], OWN):
            rows = []
            for task in tasks:
                rates = measure(task, robots, rounds=3 if quick else 5)
                rows.append([task, *rates.values()])
                results.append({"task": task, "robots": robots, "steps a second": rates})
            print(table([f"{robots} robots", *rates], rows), "\n", flush=True)
    return {"engine": results}


def measure(task: str, robots: int, rounds: int) -> dict[str, float]:
    """Robot steps a second of each variant."""
    steps = STEPS[robots]
    rng = np.random.Generator(np.random.PCG64(0))
    variants: dict[str, Callable[[], Any]] = {}
    upright: dict[str, Callable[[], Any]] = {}
    fleets = [MujocoFleet(task, robots, disturbance="none", threads=n) for n in THREADS if n == 1 or robots > 1]
    low, high = fleets[0].action_low, fleets[0].action_high
    actions = SCALE * rng.uniform(low, high, (steps, robots, len(low)))
    for fleet in fleets:
        fleet.reset(seed=0)
        name = f"ours, {fleet.physics.threads} thr."
        variants[name] = lambda fleet=fleet: _fleet(fleet, actions)
        upright[name] = fleet.reset
    largest, threads = fleets[-1], fleets[-1].physics.threads
    variants[f"raw physics, {threads} thr."] = lambda: _physics(largest, actions)
    upright[f"raw physics, {threads} thr."] = largest.reset
    variants[f"mujoco.rollout, {threads} thr."] = _rollout(largest, actions)
    if robots <= LARGEST_SYNC and task not in OWN:
        envs = SyncVectorEnv([lambda: gym.make(f"{task}-v5") for _ in range(robots)])
        envs.reset(seed=0)
        upright["SyncVectorEnv"] = envs.reset
        variants["SyncVectorEnv"] = lambda: [envs.step(a.astype(np.float32)) for a in actions]
    for work in variants.values():
        work()
    seconds = take_turns(variants, rounds, before=upright)
    for fleet in fleets:
        fleet.close()
    return {name: robots * steps / float(np.median(took)) for name, took in seconds.items()}


def _fleet(fleet: MujocoFleet, actions: np.ndarray) -> None:
    for a in actions:
        _, _, violation, truncated, _ = fleet.step(a)
        over = violation | truncated
        if over.any():
            fleet.reset(options={"reset_mask": over})


def _physics(fleet: MujocoFleet, actions: np.ndarray) -> None:
    """The compiled loop over robots alone: no observations, rewards or falls."""
    everyone = np.arange(fleet.num_envs)
    for a in actions:
        fleet.physics.advance_async(everyone, a, None, fleet.task.frame_skip).results()


def _rollout(fleet: MujocoFleet, actions: np.ndarray) -> Callable[[], None]:
    """MuJoCo's own threaded rollout from the initial state, one call a timestep as a closed loop needs."""
    model, n = fleet.physics.model, fleet.num_envs
    datas = [mujoco.MjData(model) for _ in range(fleet.physics.threads)]
    spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.zeros((n, mujoco.mj_stateSize(model, spec)))
    for row in start:
        mujoco.mj_getState(model, datas[0], row, spec)
    roller = mujoco.rollout.Rollout(nthread=len(datas) if len(datas) > 1 else 0)
    skip = fleet.task.frame_skip

    def work() -> None:
        state = start
        for a in actions:
            states, _ = roller.rollout(model, datas, state, np.repeat(a[:, None], skip, axis=1))
            state = states[:, -1]

    return work
