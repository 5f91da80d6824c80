"""The learner in its own process: it never holds up a timestep, and its death costs nothing.

What people did comes to it through the durable record, so a learner that starts anew, after a crash or with the server,
learns from all that was acknowledged. Transitions for the critics come through a pipe and may be lost. Weights come back
through it and replace those of the acting policy between two timesteps.

It takes so many gradient steps for each new sample, as fast as it can, whatever the schedule of the run says (unless it is
"never"); so a policy changes only when people did something. Critics follow their schedule.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from tutelage.console.packing import Tree, pack, unpack
from tutelage.fleet.step import Step
from tutelage.learning.imitation import ImitationLearner
from tutelage.policies.weights import load_module_state, module_state

Array = NDArray[Any]

BACKLOG = 200
"""Timesteps that may wait for the learner; then the oldest are dropped."""
FETCH = 0.05
"""Seconds between two looks at what there is to send."""
RETRY = 2.0
"""Seconds until a learner that died is started again."""


def weights_of(learner: ImitationLearner) -> Tree:
    """All that acts: the policy, the critics and the classifier, without what only learning needs."""
    return {
        "policy": module_state(learner.policy),
        "critics": {name: module_state(critic.net) for name, critic in learner.critics.items()},
        **({"classifier": module_state(learner.classifier.net)} if learner.classifier else {}),
    }


def load_weights(learner: ImitationLearner, weights: Tree) -> None:
    """Let a learner's networks be those."""
    load_module_state(learner.policy, weights["policy"])
    learner.policy.forget()
    for name, critic in learner.critics.items():
        load_module_state(critic.net, weights["critics"][name])
    if learner.classifier:
        load_module_state(learner.classifier.net, weights["classifier"])


class ProcessLearner:
    """The loop's learner: sends what happened to a process, and swaps in the weights that come back.

    Args:
        folder: of the server; its record and its `learner.safetensors` are what the process begins with.
        acting: the learner whose networks act; its data are not used.
        version: how often the weights were replaced before.
        per_sample, swap_every, save_every: see `EngineConfig`.
        notice: told (level, text) when the process died.
        swapped: told (version, id of the newest sample that the weights know) after each swap.
    """

    def __init__(
        self,
        folder: Path,
        acting: ImitationLearner,
        version: int,
        per_sample: float,
        swap_every: float,
        save_every: float,
        notice: Callable[[str, str], None] = lambda level, text: None,
        swapped: Callable[[int, int], None] = lambda version, seen: None,
    ) -> None:
        self.version, self.restarts, self.seen = version, 0, 0
        self.swap_seconds = 0.0
        """How long the last swap took, which is what learning costs a timestep."""
        self._folder, self._acting, self._notice, self._swapped = folder, acting, notice, swapped
        self._numbers = [str(x) for x in (per_sample, swap_every, save_every)]
        self._lock = threading.Condition()
        self._outbox: deque[Step] = deque(maxlen=BACKLOG)
        self._news: Tree | None = None
        self._closing = False
        self._process: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._run, name="learner", daemon=True)

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.poll() is None

    @property
    def pid(self) -> int | None:
        """Its number, if it runs."""
        return self._process.pid if self._process is not None and self.alive else None

    def start(self) -> None:
        """Start the process; it takes some seconds until it learns."""
        self._thread.start()

    def close(self, timeout: float = 10.0) -> None:
        """Let the process save what it knows and end."""
        with self._lock:
            self._closing = True
            self._lock.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout)
        if self.alive and self._process is not None:
            self._process.kill()

    # -- the learner of the loop --------------------------------------------------------------------------------

    def record(self, step: Step) -> None:
        """Send a timestep on its way, for the critics."""
        if self._acting.critics:  # what people do is in the record
            self._outbox.append(step)

    def update(self, t: int) -> dict[str, float]:
        """Swap in the newest weights, if there are any; returns the losses that came with them."""
        with self._lock:
            news, self._news = self._news, None
        if news is None:
            return {}
        began = time.perf_counter()
        load_weights(self._acting, news["weights"])
        self.swap_seconds = time.perf_counter() - began
        if news["taught"]:  # not the critics alone
            self.version, self.seen = self.version + 1, int(news["seen"])
            self._swapped(self.version, self.seen)
        return {name: float(loss) for name, loss in news["losses"].items()}

    def state_dict(self) -> dict[str, Any]:
        """Nothing: the process keeps its own state."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing to restore."""

    # -- the process, and the threads that talk to it -----------------------------------------------------------

    def _run(self) -> None:
        while not self._closing:
            connection = self._launch()
            reader = threading.Thread(target=self._read, args=(connection,), name="learner-news", daemon=True)
            reader.start()
            self._write(connection, reader)
            assert self._process is not None
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(8.0 if self._closing else 0.5)
            if self._process.poll() is None:
                self._process.kill()
                self._process.wait()
            reader.join()  # the process is gone, so there is nothing more to read
            connection.close()
            if self._closing:
                return
            self.restarts += 1
            self._notice("warning", "the learner died; robots go on with the newest policy, and it is started again")
            with self._lock:
                self._lock.wait_for(lambda: self._closing, RETRY)

    def _launch(self) -> Connection:
        ours, theirs = socket.socketpair()
        command = [
            sys.executable,
            "-m",
            "tutelage.console.training",
            str(theirs.fileno()),
            str(self._folder),
            *self._numbers,
        ]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p), "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(command, pass_fds=[theirs.fileno()], env=environment, stdin=subprocess.DEVNULL)
        theirs.close()
        return Connection(ours.detach())

    def _write(self, connection: Connection, reader: threading.Thread) -> None:
        while True:
            with self._lock:  # the loop wakes nobody: what it has to say is fetched
                if self._lock.wait_for(lambda: self._closing or not reader.is_alive(), FETCH):
                    break
            try:
                while self._outbox:
                    connection.send_bytes(pack(_transitions(self._outbox.popleft())))
            except OSError:
                break
        if self._closing:
            with contextlib.suppress(OSError):
                connection.send_bytes(pack({"quit": True}))

    def _read(self, connection: Connection) -> None:
        try:
            while True:
                news = unpack(connection.recv_bytes())
                with self._lock:
                    if self._news is not None:  # not fetched yet
                        news["taught"] |= self._news["taught"]
                    self._news = news
        except (OSError, EOFError, ValueError):
            with self._lock:
                self._lock.notify_all()


def _transitions(step: Step) -> Tree:
    """What critics learn from: the transitions of the robots that moved."""
    names = ("obs", "actions", "next_obs", "violation", "success", "truncated")
    return {"t": step.t, **{name: getattr(step, name)[step.moved] for name in names}}
