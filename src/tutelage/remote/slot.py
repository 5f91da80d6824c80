"""What a server knows of one robot of its fleet. Bookkeeping without network or threads: messages and times are passed in.

Times are of the server's own monotonic clock, in seconds. A robot is in reach while observations of it keep coming; what its
own clock says plays no part.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.remote.messages import Answer, Counts, Description, Flag, Malformed, Observation, Picture
from tutelage.remote.wire import unpack_observation, unpack_picture

Array = NDArray[Any]

WATCHING = 2.0
"""Seconds for which a camera goes on sending after somebody looked at its picture."""


class Slot:
    """One robot.

    Attributes:
        name: of its node.
        newest, heard_at: the newest observation and when it came; None and never before the first one.
        delivered: the one that the loop was given last.
        description: what it said of itself since its present start; None: not asked yet, or not fitting the fleet.
        misfit: why its description does not fit; "" if it does.
        reset: what is to be asked of it: "soft", "hard" or "".
        accepted: its answer to that; None: it has none given yet.
        stop, clear: whether the emergency stop, or its end, is to be sent until the robot shows it.
        counts: messages that were dropped, by reason.
        round_trip: seconds from a command to the first observation after it arrived, without what the robot waited itself;
            smoothed. NaN: not known yet.
        starts: how often it was switched on while we listened.
        was_online: what the loop was told last.
        asking, ask_at, stop_at: is it being asked something, when to ask next, and when it was last told to stop or go on.
        pictures: the newest of each camera, by name, and when it came in seconds since 1970.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.newest: Observation | None = None
        self.heard_at = float("-inf")
        self.delivered: Observation | None = None
        self.description: Description | None = None
        self.misfit = ""
        self.reset, self.reset_number = "", 0
        self.seed: int | None = None
        self.accepted: Answer | None = None
        self.stop = self.clear = False
        self.counts = Counts()
        self.round_trip = float("nan")
        self.starts = 0
        self.pictures: dict[str, tuple[float, Picture]] = {}
        self.asking = self.was_online = False
        self.ask_at = self.stop_at = float("-inf")
        self._past: deque[int] = deque(maxlen=64)
        self._sent: OrderedDict[int, float] = OrderedDict()
        self._watched: dict[str, float] = {}
        self._answered = 0

    # -- what comes -------------------------------------------------------------------------------------------------------

    def observe(self, data: bytes, fleet: Description | None, server: int, now: float) -> bool:
        """An observation came. Was it taken?

        fleet: what robots of this fleet are; None: not known yet. server: this start of the server.
        """
        try:
            seen = unpack_observation(data)
        except Malformed:
            return self._drop("malformed")
        if fleet is not None and not self._fits(seen, fleet):
            return self._drop("shape")
        before = self.newest
        if before is None or seen.boot != before.boot:
            if seen.boot in self._past:
                return self._drop("other_start")
            if before is not None:
                self._past.append(before.boot)
            self.starts += 1
            self.reset, self.accepted = "", None  # a start is a reset
            self.description, self.misfit, self.ask_at = None, "", float("-inf")
            self.pictures.clear()
        elif seen.number <= before.number:
            return self._drop("replaced")
        self.newest, self.heard_at = seen, now
        if seen.server == server and seen.heard > self._answered:
            self._answered = seen.heard
            sent = self._sent.get(seen.heard)
            if sent is not None:
                took = max(0.0, now - sent - seen.waited)
                self.round_trip = took if np.isnan(self.round_trip) else self.round_trip + 0.2 * (took - self.round_trip)
        self.settle()
        stopped = bool(seen.flags & Flag.STOPPED)
        if self.clear and not stopped and now - self.stop_at > 0:
            self.clear = False
        return True

    def settle(self) -> None:
        """Is the reset that the robot accepted over?"""
        seen, answer = self.newest, self.accepted
        if seen is None or answer is None or seen.flags & Flag.RESETTING:
            return
        if seen.boot != answer.boot or seen.episode > answer.episode:
            self.reset, self.accepted = "", None

    def look(self, data: bytes, camera: str, now: float) -> bool:
        """A picture came on the topic of a camera (its name; now in seconds since 1970). Was it taken?"""
        try:
            picture = unpack_picture(data)
        except Malformed:
            return self._drop("malformed")
        if self.newest is None or picture.boot != self.newest.boot:
            return self._drop("other_start")
        before = self.pictures.get(camera)
        if before is not None and picture.number <= before[1].number:
            return self._drop("replaced")
        self.pictures[camera] = now, picture
        return True

    # -- how it is --------------------------------------------------------------------------------------------------------

    @property
    def stopped(self) -> bool:
        """Is the emergency stop wanted, or latched on the robot?"""
        return self.stop or self.clear or (self.newest is not None and bool(self.newest.flags & Flag.STOPPED))

    def has(self, flag: Flag) -> bool:
        """Does the newest observation show it?"""
        return self.newest is not None and bool(self.newest.flags & flag)

    def state(self, now: float, deadline: float) -> str:
        """One word: never, gone, misfit, asking, stopped, resetting, fault, or online. Only the last one can be driven."""
        if self.misfit:
            return "misfit"
        if self.newest is None:
            return "never"
        if now - self.heard_at > deadline:
            return "gone"
        if self.stopped:
            return "stopped"
        if self.description is None:
            return "asking"
        if self.reset or self.has(Flag.RESETTING):
            return "resetting"
        return "fault" if self.has(Flag.FAULT) else "online"

    def sent(self, number: int, now: float) -> None:
        """A command went out."""
        self._sent[number] = now
        while len(self._sent) > 256:
            self._sent.popitem(last=False)

    def watch(self, camera: str, now: float) -> None:
        """Somebody looks at a camera (its name)."""
        self._watched[camera] = now

    def watched(self, now: float) -> int:
        """The cameras that somebody looks at, a bit each, in the robot's own order: it may lack one that others have."""
        names = self.description.cameras if self.description is not None else ()
        return sum(1 << k for k, name in enumerate(names) if now - self._watched.get(name, float("-inf")) < WATCHING)

    def settle_on(self, fleet: Description) -> None:
        """It is known now what robots of this fleet are: what came before may not fit."""
        if self.newest is not None and not self._fits(self.newest, fleet):
            self._drop("shape")
            self.newest = self.delivered = None

    def _fits(self, seen: Observation, fleet: Description) -> bool:
        obs, proposal = seen.obs, seen.proposal
        if obs.shape != fleet.shape or obs.dtype != np.dtype(fleet.dtype):
            self.misfit = f"observes {obs.shape} {obs.dtype}, and the fleet {fleet.shape} {fleet.dtype}"
            return False
        if proposal is not None and len(proposal) != len(fleet.action_low):
            self.misfit = f"proposes {len(proposal)} numbers, and an action has {len(fleet.action_low)}"
            return False
        return True

    def _drop(self, reason: str) -> bool:
        self.counts.add(reason)
        return False
