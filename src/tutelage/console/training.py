"""The learner's process: `python -m tutelage.console.training`, which `ProcessLearner` starts and talks to."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import torch

from tutelage.console.audit import samples_in
from tutelage.console.packing import Tree, pack, unpack
from tutelage.console.parts import learner_in, load_learner, save_learner
from tutelage.console.trainer import weights_of
from tutelage.errors import TutelageError
from tutelage.fleet.events import Events
from tutelage.fleet.step import Step
from tutelage.learning.imitation import ImitationLearner

MOST_OWED = 5000.0
"""Gradient steps that may be owed for new samples: when people teach faster than it learns, it catches up when they rest."""


class Training:
    """What the process does: take in samples and transitions, improve, send weights, save.

    Args:
        folder: of the server.
        learner: with the state of the folder's `learner.safetensors`.
        seen: id of the last sample that it knows.
        per_sample, swap_every, save_every: see `EngineConfig`.
    """

    CHUNK = 5

    def __init__(
        self, folder: Path, learner: ImitationLearner, seen: int, per_sample: float, swap_every: float, save_every: float
    ) -> None:
        self.folder, self.learner, self.seen = folder, learner, seen
        self._per_sample, self._swap_every, self._save_every = per_sample, swap_every, save_every
        self.owed = 0.0
        self.losses: dict[str, float] = {}
        self._improved = self._taught = self._unsaved = False
        self._read_at = self._sent_at = 0.0
        self._saved_at = time.monotonic()

    def take_in(self, message: Tree, learn: bool) -> None:
        """A timestep of the loop: what the critics learn from, and when."""
        self.learner.record(_step(message))
        for name, critic in self.learner.critics.items():
            if learn and self.learns and (int(message["t"]) + 1) % critic.config.every == 0:
                self.losses[name] = critic.update()
                self._improved = True

    @property
    def learns(self) -> bool:
        """Whether the policy may change."""
        return self.learner.config.schedule != "never"

    def read_samples(self) -> None:
        """New rows of the record."""
        obs, wanted = [], []
        for sample in samples_in(self.folder, self.seen):
            obs.append(sample.arrays["obs"])
            wanted.append(sample.arrays["wanted"])
            self.seen = sample.id
        if obs:
            self.learner.dataset.add(np.stack(obs), np.stack(wanted))
            self._unsaved = True
            if self.learns:
                self.owed = min(self.owed + self._per_sample * len(obs), MOST_OWED)

    def improve(self) -> None:
        """Some of the gradient steps that are owed for new samples."""
        steps = int(min(self.CHUNK, self.owed))
        if steps:
            self.losses["policy"] = self.learner.gradient_steps(steps)
            if self.learner.classifier:
                self.losses["classifier"] = self.learner.classifier.updates(steps)
            self.owed -= steps
            self._improved = self._taught = True

    def weights_due(self, now: float) -> Tree | None:
        """What to send, if something is new and it is time."""
        if not self._improved or now - self._sent_at < self._swap_every:
            return None
        taught, self._taught = self._taught, False
        self._improved, self._unsaved, self._sent_at = False, True, now
        losses = {name: loss for name, loss in self.losses.items() if np.isfinite(loss)}
        return {"weights": weights_of(self.learner), "losses": losses, "seen": self.seen, "taught": taught}

    def save(self) -> None:
        """Keep the state, and the policy for everybody."""
        save_learner(self.folder, self.learner, self.seen, 0)
        self.learner.policy.save(self.folder / "policy.safetensors", {"seen": self.seen})
        self._unsaved, self._saved_at = False, time.monotonic()

    def run(self, connection: Connection) -> None:
        """Until the server says so, or is gone."""
        while True:
            messages: list[Tree] = []
            while connection.poll(0.0 if messages or self.owed >= 1 else 0.1):
                messages.append(unpack(connection.recv_bytes()))
                if "quit" in messages[-1]:
                    with contextlib.suppress(TutelageError):  # as below
                        self.read_samples()
                        self.save()
                    return
            for k, message in enumerate(messages):
                self.take_in(message, learn=k >= len(messages) - self.CHUNK)  # when late, only data are taken in
            now = time.monotonic()
            if now - self._read_at >= 0.25:
                self.read_samples()
                self._read_at = now
            self.improve()
            news = self.weights_due(now)
            if news is not None:
                connection.send_bytes(pack(news))
            if self._unsaved and now - self._saved_at >= self._save_every:
                self._saved_at = now
                with contextlib.suppress(TutelageError):  # the disk is full; the record still has all that matters
                    self.save()


def _step(message: Tree) -> Step:
    """The transitions of robots that moved, as a step of a fleet of them, which nobody helps."""
    n = len(message["obs"])
    zeros, nobody = np.zeros(n, dtype=np.int8), np.full(n, -1)
    return Step(
        int(message["t"]), message["obs"], message["actions"], message["actions"], np.full_like(message["actions"], np.nan),
        zeros, nobody, np.zeros(n), message["next_obs"], message["violation"], message["success"], message["truncated"],
        Events.concatenate([]),
    )  # fmt: skip


def main(arguments: list[str]) -> None:
    """The process: file number of the pipe, folder, per_sample, swap_every, save_every."""
    connection, folder = Connection(int(arguments[0])), Path(arguments[1])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which then says "quit"
    with contextlib.suppress(OSError):
        os.nice(10)
    learner = learner_in(folder)
    torch.set_num_threads(1)
    seen, _ = load_learner(folder, learner)
    training = Training(folder, learner, seen, *(float(x) for x in arguments[2:5]))
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        training.run(connection)


if __name__ == "__main__":
    main(sys.argv[1:])
