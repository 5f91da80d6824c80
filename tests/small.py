"""Runs that are small enough for tests: six robots, tiny networks, on the point fleet or on Walker2d."""

from __future__ import annotations

import json
import sqlite3
from concurrent.futures import Future
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from fakes import POSITION, PointFleet
from gymnasium.vector.utils import batch_space

from tutelage.experiments.config import RunConfig
from tutelage.fleet.priority import PriorityConfig
from tutelage.fleet.view import FleetView
from tutelage.learning.critic import CriticConfig
from tutelage.learning.imitation import LearnerConfig
from tutelage.store import load_tree

FLAGS = [
    "--robots",
    "6",
    "--humans",
    "2",
    "--steps",
    "30",
    "--offline-pairs",
    "1000",
    "--calibration-steps",
    "10",
    "--hidden",
    "16",
    "--learner.pretrain",
    "20",
    "--learner.batch",
    "32",
    "--critic.pretrain",
    "20",
    "--critic.hidden",
    "16",
    "--critic.batch",
    "32",
    "--threads",
    "1",
    "--torch-threads",
    "1",
    "--checkpoint-every",
    "10",
    "--metrics-every",
    "5",
    "--record",
    "all",
]
"""`walker()` on the command line."""


def walker(out: Path, **changes: Any) -> RunConfig:
    """Walker2d at its own level, with the shipped expert."""
    learner = {"pretrain": 20, "batch": 32, **changes.pop("learner", {})}
    settings: dict[str, Any] = {
        "task": "Walker2d", "robots": 6, "humans": 2, "steps": 30, "offline_pairs": 1000, "calibration_steps": 10,
        "hidden": (16,), "critic": CriticConfig(pretrain=20, hidden=(16,), batch=32), "threads": 1, "torch_threads": 1,
        "checkpoint_every": 10, "metrics_every": 5, "record": "all", "out": out,
    }  # fmt: skip
    return RunConfig(**{**settings, "learner": LearnerConfig(**learner), **changes})


def points(out: Path, **changes: Any) -> RunConfig:
    """Points on a line that are pushed about, with a human who brings them home."""
    settings = {"task": "small:point_fleet", "expert": "small:Homing", "offline_pairs": 100, "threads": None}
    return walker(out, **{**settings, **changes})


def point_fleet(num_envs: int) -> PointFleet:
    """A fleet of the user's own: it knows no levels of disturbance and no threads."""
    return PointFleet(num_envs, bound=0.6, horizon=25, noise=0.08, start=0.3)


class Homing:
    """The way home."""

    def act(self, obs: Any) -> Any:
        return np.clip(-5 * obs[:, [POSITION]], -1, 1).astype(np.float32)


class Reaching:
    """The way to the goal of `goal_fleet`."""

    def act(self, obs: Any) -> Any:
        return np.clip(5 * (0.25 - obs[:, [POSITION]]), -1, 1).astype(np.float32)


class Worry:
    """A priority of the user's own, with a critic, a threshold and a memory: who fell, then who was at risk so far."""

    needs = ("risk",)

    def __init__(self, thresholds: PriorityConfig) -> None:
        self.limit = thresholds.risk or 0.0
        self.worry = np.zeros(0)

    def __call__(self, view: FleetView) -> Any:
        past = self.worry if len(self.worry) else np.zeros(view.num_robots)
        self.worry = 0.9 * past + np.where(view.risk > self.limit, view.risk, 0.0)
        return np.stack([view.violation, np.where(view.violation, 0.0, self.worry)], axis=1)

    def state_dict(self) -> dict[str, Any]:
        return {"worry": self.worry.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.worry = state["worry"].copy()


class GoalFleet(PointFleet):
    """Points with a goal state."""

    goal_conditioned = True


def goal_fleet(num_envs: int) -> GoalFleet:
    return GoalFleet(num_envs, bound=0.9, goal=0.15, horizon=25, noise=0.05, start=0.3)


class PictureFleet(GoalFleet):
    """The same, seen by a camera: a bright bar stands where the point is."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs, bound=0.9, goal=0.15, horizon=25, noise=0.05, start=0.3)
        self.single_observation_space = gym.spaces.Box(0, 255, (64, 64, 3), dtype=np.uint8)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    @property
    def state(self) -> Any:
        return self.obs

    def pictures(self) -> Any:
        seen = np.full((self.num_envs, 64, 64, 3), 40, dtype=np.uint8)
        for picture, position in zip(seen, self.obs[:, POSITION], strict=True):
            middle = int(np.clip(32 + 30 * position, 3, 60))
            picture[:, middle - 3 : middle + 3] = 220
        return seen

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        _, info = super().reset(seed=seed, options=options)
        return self.pictures(), info

    def step_wait(self) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        _, reward, terminated, truncated, info = super().step_wait()
        return self.pictures(), reward, terminated, truncated, info


def picture_fleet(num_envs: int, observation: str) -> PictureFleet:
    assert observation == "images"
    return PictureFleet(num_envs)


def pictures(out: Path, **changes: Any) -> RunConfig:
    """Points seen by a camera, with a human who knows where they are: tiny heads, few and small batches."""
    critic = CriticConfig(pretrain=3, hidden=(8,), batch=4)
    settings = {
        "task": "small:picture_fleet", "observation": "images", "expert": "small:Reaching", "critic": critic, "hidden": (8,),
        "members": 2, "robots": 3, "humans": 1, "steps": 24, "offline_pairs": 30, "calibration_steps": 5,
        "learner": {"pretrain": 3, "batch": 4, "every": 2},
    }  # fmt: skip
    return points(out, **{**settings, **changes})


def contents(folder: Path) -> dict[str, Any]:
    """What a run left behind, to be compared: metrics to the byte, events, frames and weights to the bit."""
    import pyarrow.parquet as pq

    with closing(sqlite3.connect(folder / "events.sqlite")) as database:
        events = database.execute("SELECT t, robot, human, event, mode FROM events ORDER BY rowid").fetchall()
    frames = [row for path in sorted(folder.glob("episodes/*.parquet")) for row in pq.read_table(path).to_pylist()]
    weights = load_tree(folder / "policy.safetensors")["weights"]
    return {
        "metrics": (folder / "metrics.jsonl").read_bytes(),
        "events": events,
        "frames": frames,
        "weights": {name: array.tobytes() for name, array in weights.items()},
    }


def assert_same(one: Path, other: Path) -> None:
    """Two run folders tell the same story."""
    a, b = contents(one), contents(other)
    assert a["events"], "a comparison of nothing"
    for name in a:
        assert a[name] == b[name], f"{name} differ"


def edit_config(folder: Path, **changes: Any) -> None:
    """Change the stored configuration of a run."""
    path = folder / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


class Here:
    """A pool of one: this process."""

    def __init__(self, workers: int, mp_context: Any) -> None:
        pass

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *args: Any) -> None:
        pass

    def submit(self, work: Any, *args: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(work(*args))
        except Exception as error:
            future.set_exception(error)
        return future
