"""A robot for the tests: a point on a table that writes down, with times, all that is done to it.

`POINT_LOG` names the file. `FILE.fail`: the driver raises while that file exists. `FILE.slow`: seconds an action takes.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import gymnasium as gym
import numpy as np


class Point:
    """Moves by a tenth of each action; beyond 3 it violates its constraint, within 0.1 of (1, 1) it succeeds."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    task = "Point"
    horizon = 500
    goal = True

    def __init__(self) -> None:
        self.log = Path(os.environ["POINT_LOG"])
        self.at = np.zeros(2, np.float32)
        self.file = self.log.open("a", buffering=1)

    def note(self, *words: object) -> None:
        print(f"{time.monotonic():.4f}", *words, file=self.file)

    def get_observation(self) -> np.ndarray:
        if self.log.with_suffix(".fail").exists():
            raise OSError("the sensor is unplugged")
        return self.at.copy()

    def send_action(self, action: np.ndarray) -> None:
        self.note("act", *action)
        slow = self.log.with_suffix(".slow")
        if slow.exists():
            time.sleep(float(slow.read_text()))
        self.at = self.at + np.float32(0.1) * action

    def hold(self) -> None:
        self.note("hold")

    def stop(self) -> None:
        self.note("stop")

    def release(self) -> None:
        self.note("release")

    def reset(self, hard: bool, seed: int | None) -> None:
        self.note("reset", "hard" if hard else "soft")
        self.at = np.zeros(2, np.float32)

    def violation(self) -> bool:
        return bool((abs(self.at) > 3).any())

    def success(self) -> bool:
        return bool(np.linalg.norm(self.at - 1) < 0.1)

    def cameras(self) -> dict[str, object]:
        picture = np.zeros((48, 64, 3), np.uint8)
        picture[:, :, 0] = 200
        return {"front": lambda: picture}


class Plane(Point):
    """One that does not fit into a fleet of points."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (5,), np.float32)

    def get_observation(self) -> np.ndarray:
        return np.zeros(5, np.float32)
