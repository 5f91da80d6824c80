"""Runs that end before their time: stopped, or killed at a chosen moment in a process of their own."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tutelage.experiments.config import RunConfig
from tutelage.experiments.run import Run
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step

FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(["tutelage.experiments.run", "tutelage.envs.mujoco_fleet", "pyarrow.parquet", "small"])


class At:
    """Does something when a timestep is over: after it is written down, before a checkpoint is due."""

    def __init__(self, t: int, what: Callable[[Loop], Any]) -> None:
        self.t, self.what = t, what

    def on_start(self, loop: Loop) -> None:
        pass

    def on_step(self, loop: Loop, step: Step) -> None:
        if loop.t == self.t:
            self.what(loop)

    def on_end(self, loop: Loop) -> None:
        pass


def die(loop: Loop | None = None) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def stop(loop: Loop) -> None:
    loop.stop_requested = True


def killed(target: Callable[..., None], *args: Any) -> None:
    """Run `target` in a process of its own, which must not survive."""
    process = FORKS.Process(target=target, args=args)
    process.start()
    process.join(120)
    assert process.exitcode == -signal.SIGKILL


def resume(folder: Path) -> int:
    """Continue to the end; returns the timestep at which the run went on."""
    run = Run.resume(folder)
    t = run.loop.t
    run.run()
    return t


def die_after(config: RunConfig, t: int) -> None:
    Run.start(config).run([At(t, die)])
