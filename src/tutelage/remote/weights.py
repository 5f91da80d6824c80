"""The policy on the robots: they fetch its weights from the server, decide by themselves, and the server overrides.

On the server:

    shared = SharedPolicy(fleet, policy)
    Loop(fleet, shared, ..., subscribers=[shared])

On a robot: `tutelage robot HOME --env ... --policy`. What a robot proposes comes with its observations; where the loop does
not change it, the robot goes on with its own policy at its own rate, else it executes the server's action. Without a fresh
word from the server it holds, as ever.

Weights travel as safetensors, whole, sealed, and only to who may ask for them; nothing is unpickled.
"""

from __future__ import annotations

import logging
import secrets
import tempfile
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ContractError, TutelageError
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.remote import topics
from tutelage.remote.fleet import RemoteFleet
from tutelage.remote.messages import Weights
from tutelage.remote.telling import told
from tutelage.remote.wire import pack_weights, unpack_weights
from tutelage.sgc.node import Node

log = logging.getLogger(__name__)

Array = NDArray[Any]

FETCH_EVERY = 1.0
"""Seconds between a robot's questions for newer weights."""

SHARE_EVERY = 1.0
"""Seconds between two versions, at least: a learner that changes the weights at every step need not show all of them."""


class Saved(Protocol):
    """A policy that can be written to a file, such as `EnsemblePolicy`."""

    def act(self, obs: Array) -> Array: ...

    def uncertainty(self, obs: Array) -> Array: ...

    def save(self, path: Path, card: dict[str, Any]) -> None: ...


class SharedPolicy:
    """A policy of the server that its robots have, too. A policy for the loop, and a subscriber of it.

    Attributes:
        version: of the weights that were handed out last; counts up from a random number.
    """

    def __init__(self, fleet: RemoteFleet, policy: Saved) -> None:
        """
        Raises:
            NotAllowed: the fleet network's policy does not let the server hand out weights.
        """
        self.fleet, self.policy = fleet, policy
        self.version = secrets.randbits(31)  # no other start of the server has it: robots may still have that one's weights
        self._shared_at = float("-inf")
        self._changed = False
        self.share()

    def act(self, obs: Array) -> Array:
        """What the robots propose; for those that have no weights, or others, what the policy here would do."""
        here = self.policy.act(obs)
        proposals, versions = self.fleet.proposals()
        return np.asarray(np.where((versions == self.version)[:, None], proposals, here), dtype=np.float32)

    def uncertainty(self, obs: Array) -> Array:
        """Of the policy here."""
        return self.policy.uncertainty(obs)

    def share(self) -> None:
        """Hand out the present weights."""
        self._shared_at = time.monotonic()
        version = self.version + 1
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "policy.safetensors"
            self.policy.save(path, {"version": version})
            self.fleet.offer_policy(Weights(version, path.read_bytes()))
        self.version, self._changed = version, False

    def on_start(self, loop: Loop) -> None:
        """Nothing to do."""

    def on_step(self, loop: Loop, step: Step) -> None:
        """Hand out new weights after something was learned."""
        self._changed |= bool(step.losses)
        if self._changed and time.monotonic() - self._shared_at >= SHARE_EVERY:
            try:
                self.share()
            except (TutelageError, OSError) as error:  # the disk is full, for instance; robots go on with what they have
                log.warning("the robots do not get the newest weights yet: %s", told(error))

    def on_end(self, loop: Loop) -> None:
        """Hand out what was learned last."""
        if self._changed:
            self.share()


class PulledPolicy:
    """On a robot: the server's policy, fetched again whenever there is a newer one, and swapped between two timesteps."""

    def __init__(self, node: Node) -> None:
        """
        Raises:
            ConfigError: the fleet network's policy does not let the robot ask for weights.
        """
        node.access.entry(topics.WEIGHTS)
        self.node = node
        EnsemblePolicy(1, np.array([-1.0]), np.array([1.0]), members=1)  # compiles, or loads what is: before the robot moves
        self._now: tuple[int, EnsemblePolicy | None] = (0, None)
        self._trouble = ""
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._fetch, name="robot-policy", daemon=True)
        self._thread.start()

    @property
    def version(self) -> int:
        """Of the weights; 0: there are none yet."""
        return self._now[0]

    def act(self, obs: Array) -> Array:
        """(n, ...) -> (n, A) float32.

        Raises:
            ContractError: there are no weights yet.
        """
        policy = self._now[1]
        if policy is None:
            raise ContractError("there are no weights of the policy on this robot yet")
        policy.forget()
        return policy.act(obs)

    def close(self) -> None:
        """Ask no more."""
        self._closed.set()
        self._thread.join(5.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _fetch(self) -> None:
        while not self._closed.is_set():
            try:
                asked = pack_weights(Weights(self.version, b""))
                self._take(unpack_weights(self.node.request(topics.WEIGHTS, asked, 3.0)))
            except TutelageError as error:
                log.info("%s: %s", self.node.name, error)
            except Exception as error:  # a disk that is full, a damaged file: the next ones may be good
                if self._trouble != told(error):
                    self._trouble = told(error)
                    log.warning("%s goes on with the policy that it has: %s", self.node.name, self._trouble)
            else:
                self._trouble = ""
            self._closed.wait(FETCH_EVERY)

    def _take(self, weights: Weights) -> None:
        if not weights.data or weights.version == self.version:
            return
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "policy.safetensors"
            path.write_bytes(weights.data)
            policy, _ = EnsemblePolicy.load(path)
        self._now = weights.version, policy
