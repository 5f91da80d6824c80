"""The robots of a fleet network as its server knows them: a `Slot` each, what all of them are, and the lock of all this."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tutelage.errors import ConfigError, TutelageError
from tutelage.files import write_atomic
from tutelage.remote.messages import MAX_CAMERAS, Description, Flag, Malformed
from tutelage.remote.slot import Slot

log = logging.getLogger(__name__)


class Robots:
    """N robots, whether they are there or not.

    Attributes:
        slots: of each robot, (N,).
        news: held to look at the slots or change them; notified when something came.
        description: what each of them is; None: not known yet.
    """

    def __init__(self, names: Sequence[str], deadline: float, file: Path, description: Description | None = None) -> None:
        """
        Args:
            names: of the robots.
            deadline: seconds without an observation after which a robot is out of reach; at least three of its timesteps.
            file: what robots are is kept there, so that a server that starts again need not wait for one of them.
            description: what they are; default: what the file says, or else the first robot.
        """
        self.slots = [Slot(name) for name in names]
        self.news = threading.Condition()
        self._deadline, self._file = deadline, file
        self.description = description or self._remembered()

    def __len__(self) -> int:
        return len(self.slots)

    def __iter__(self) -> Iterator[Slot]:
        return iter(self.slots)

    def reach(self, slot: Slot) -> float:
        """Seconds without an observation after which this robot is out of reach."""
        known = slot.description or self.description
        return max(self._deadline, 3 * known.dt) if known is not None else self._deadline

    def here(self, slot: Slot, now: float) -> bool:
        """Was it heard within its deadline?"""
        return slot.newest is not None and now - slot.heard_at <= self.reach(slot)

    def states(self, now: float) -> list[str]:
        """`Slot.state` of each, (N,)."""
        return [slot.state(now, self.reach(slot)) for slot in self.slots]

    def introduce(self, slot: Slot, said: Description) -> None:
        """A robot has said what it is. The first one says it for all. With the lock held."""
        if self.description is None:
            self.description = said
            for other in self.slots:
                other.settle_on(said)
            self._remember()
        if said.matches(self.description):
            slot.description = said
            more = tuple(name for name in said.cameras if name not in self.description.cameras)
            if more and len(self.description.cameras) + len(more) <= MAX_CAMERAS:  # the first one lacked a camera, perhaps
                self.description = replace(self.description, cameras=self.description.cameras + more)
                self._remember()
        else:
            slot.misfit = _difference(said, self.description)
            self.misfits(slot)

    def misfits(self, slot: Slot) -> None:
        """Say that a robot does not fit, and what to do."""
        log.warning("%s does not fit into this fleet: %s", slot.name, self._says(slot))

    def _says(self, slot: Slot) -> str:
        return f"{slot.misfit}; if the fleet is another one now, remove {self._file}" if slot.misfit else ""

    def known(self, wait: float) -> Description:
        """What robots are, as soon as one has said so.

        Raises:
            ConfigError: none has within `wait` seconds.
        """
        with self.news:
            self.news.wait_for(lambda: self.description is not None, wait)
        if self.description is None:
            names = ", ".join(slot.name for slot in self.slots[:5])
            raise ConfigError(
                f"no robot of {names}{' ...' if len(self) > 5 else ''} answered within {wait:g} s; "
                "start one: tutelage robot HOME --env TASK"
            )
        return self.description

    def status(self) -> list[dict[str, Any]]:
        """A row of each robot; see `RemoteFleet.status`."""
        now = time.monotonic()
        with self.news:
            rows = []
            for slot, state in zip(self.slots, self.states(now), strict=True):
                seen = slot.newest
                rows.append(
                    {
                        "name": slot.name,
                        "state": state,
                        "age": now - slot.heard_at if seen is not None else None,
                        "round_trip": None if np.isnan(slot.round_trip) else slot.round_trip,
                        "episode": seen.episode if seen is not None else 0,
                        "step": seen.step if seen is not None else 0,
                        "held": slot.has(Flag.HELD),
                        "starts": slot.starts,
                        "stale": seen.stale if seen is not None else 0,
                        "refused_there": seen.refused if seen is not None else 0,
                        "refused_here": dict(slot.counts.by_reason),
                        "says": self._says(slot),
                    }
                )
            return rows

    def refused(self) -> dict[str, int]:
        """Messages that were dropped, by reason."""
        total: dict[str, int] = {}
        with self.news:
            for slot in self.slots:
                for reason, count in slot.counts.by_reason.items():
                    total[reason] = total.get(reason, 0) + count
        return total

    def _remember(self) -> None:
        assert self.description is not None
        try:
            write_atomic(self._file, (json.dumps(self.description.to_json(), indent=1) + "\n").encode())
        except TutelageError as error:  # the disk is full, for instance
            log.warning("the next server will have to ask the robots what they are: %s", error)

    def _remembered(self) -> Description | None:
        try:
            return Description.from_json(json.loads(self._file.read_text(encoding="utf-8")))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, Malformed) as error:
            log.warning("%s is of no use (%s); the first robot says what robots are", self._file, error)
            return None


def _difference(one: Description, other: Description) -> str:
    for name in ("task", "shape", "dtype", "action_low", "action_high"):
        if getattr(one, name) != getattr(other, name):
            return f"{name} {getattr(one, name)!r}, and the fleet has {getattr(other, name)!r}"
    return ""
