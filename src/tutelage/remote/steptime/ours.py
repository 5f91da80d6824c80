"""Robots as processes of their own, a router, and a server: what a step of `RemoteFleet` takes."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tutelage.errors import TutelageError
from tutelage.remote.fleet import RemoteFleet
from tutelage.remote.setup import new_fleet
from tutelage.sgc.ports import free_port

Array = NDArray[Any]

SIZE = "TUTELAGE_STEPTIME_SIZE"
MAIN = "from tutelage.cli import main; main()"


def picture(height: int, width: int, seed: int = 0) -> NDArray[np.uint8]:
    """What a robot's camera might see: smooth, with some noise; incompressible enough to be honest."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width]
    smooth = np.stack([x * 255 / width, y * 255 / height, (x + y) * 127 / (height + width)], axis=2)
    return np.asarray(np.clip(smooth + rng.normal(0, 6, (height, width, 3)), 0, 255), dtype=np.uint8)


class Camera:
    """A robot that sees an image and moves at once: what is left is communication."""

    task = "steptime"

    def __init__(self) -> None:
        height, width = map(int, os.environ[SIZE].split("x"))
        self.observation_space = gym.spaces.Box(0, 255, (height, width, 3), np.uint8)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.pictures = [picture(height, width, seed) for seed in range(4)]
        self.taken = 0

    def get_observation(self) -> Array:
        """The next picture."""
        self.taken += 1
        return self.pictures[self.taken % len(self.pictures)]

    def send_action(self, action: Array) -> None:
        """Done at once."""

    def hold(self) -> None:
        """Done at once."""


def measure(robots: int, steps: int, height: int, width: int, folder: Path) -> list[float]:
    """Seconds of each fleet step: an action to every robot, and the image after it from every robot."""
    port = free_port()
    made = new_fleet(folder, robots, connect=f"tls/127.0.0.1:{port}", cameras=())
    with contextlib.ExitStack() as stack:
        stack.enter_context(_running("router", made.router, "--listen", f"tls/127.0.0.1:{port}"))
        for home in made.robots:
            env = "tutelage.remote.steptime.ours:Camera"
            robot = _running("robot", home, "--env", env, "--hz", 1000, "--no-cameras", size=f"{height}x{width}")
            stack.enter_context(robot)
        fleet = stack.enter_context(contextlib.closing(RemoteFleet.connect(made.server, hz=None, deadline=5.0)))
        fleet.reset()
        actions = np.zeros((robots, 2), np.float32)
        began = time.monotonic()
        while not fleet.step(actions)[-1]["online"].all():
            if time.monotonic() > began + 30:
                raise TutelageError(f"the robots of the measurement do not come: {fleet.status()}")
        took = []
        for step in range(steps + 5):
            actions = np.full((robots, 2), step % 2, np.float32)
            start = time.perf_counter()
            info = fleet.step(actions)[-1]
            took.append(time.perf_counter() - start)
            if not info["online"].all():
                raise TutelageError(f"a robot of the measurement went out of reach: {fleet.status()}")
        return took[5:]


@contextlib.contextmanager
def _running(*words: object, size: str = "") -> Iterator[None]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", SIZE: size}
    with tempfile.TemporaryFile() as said:
        program = subprocess.Popen(
            [sys.executable, "-c", MAIN, *map(str, words)], stdout=said, stderr=subprocess.STDOUT, env=environment
        )
        try:
            yield
            if program.poll() is not None:
                said.seek(0)
                raise TutelageError(f"a process of the measurement ended: {said.read().decode(errors='replace')[-500:]}")
        finally:
            program.kill()
            program.wait()
