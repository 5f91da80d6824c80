"""The supervision server without its web: one object that any thread may ask, and that tells what happened.

The only thing that the web application talks to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from tutelage.console.states import (
    Denied,
    Description,
    Frame,
    Lease,
    LeaseEnded,
    LeaseGranted,
    Metrics,
    Notice,
    Offer,
    Snapshot,
    Stepped,
    Told,
)

__all__ = [
    "Denied", "Description", "Frame", "Lease", "LeaseEnded", "LeaseGranted", "Metrics", "Notice", "Offer", "Snapshot",
    "Stepped", "Supervision", "Told",
]  # fmt: skip


class Supervision:
    """A fleet, the people who look after it, and the policy that learns from them.

    All methods may be called from any thread and return at once, except where they say that they wait. Those that people
    call raise `Denied` where what they ask for is not possible.
    """

    description: Description

    def join(self, operator: str) -> int:
        """Take a seat: index j. The same person gets the same seat again."""
        raise NotImplementedError

    def leave(self, operator: str) -> None:
        """The person is gone: their robot holds at once; after a grace period it is offered to others."""
        raise NotImplementedError

    def available(self, operator: str, yes: bool) -> None:
        """Whether the person wants offers."""
        raise NotImplementedError

    def accept(self, operator: str, robot: int) -> Lease:
        """Take a robot that was offered."""
        raise NotImplementedError

    def decline(self, operator: str, robot: int) -> None:
        """Leave an offered robot to others; it is not offered to this person again for a while."""
        raise NotImplementedError

    def take(self, operator: str, robot: int) -> None:
        """Take a robot on one's own judgement; the lease comes as an event."""
        raise NotImplementedError

    def give_back(self, operator: str, robot: int) -> None:
        """The robot goes on by itself."""
        raise NotImplementedError

    def hand_over(self, operator: str, robot: int, to: str) -> None:
        """Offer one's robot to a certain person; one keeps it until they accept."""
        raise NotImplementedError

    def reset(self, operator: str, robot: int) -> None:
        """Begin a hard reset of the robot that one holds."""
        raise NotImplementedError

    def command(
        self,
        operator: str,
        robot: int,
        lease: str,
        seq: int,
        action: Sequence[float] | None,
        assist: bool = False,
        push: Sequence[float] | None = None,
    ) -> None:
        """What the robot is to do. The newest command wins; one with an older `seq` is dropped without a word."""
        raise NotImplementedError

    def renew(self, operator: str, lease: str) -> None:
        """The person is still there."""
        raise NotImplementedError

    def estop(self, operator: str, robot: int | None) -> None:
        """Emergency stop of a robot, or of all (None). Acts at once."""
        raise NotImplementedError

    def clear_estop(self, operator: str, robot: int | None) -> None:
        """The robot, or all, may go on."""
        raise NotImplementedError

    def snapshot(self) -> Snapshot:
        """The newest one."""
        raise NotImplementedError

    def subscribe(self, callback: Callable[[Told], None]) -> Callable[[], None]:
        """Hear of everything that happens, in order, in a thread of the server's; returns how to unsubscribe."""
        raise NotImplementedError

    def frame(self, robot: int, camera: int, width: int, height: int) -> Frame | None:
        """The newest picture; asking for it again and again is what keeps it coming. None: there is none yet."""
        raise NotImplementedError

    def metrics(self, since: int = 0) -> list[dict[str, Any]]:
        """The rows of metrics after timestep `since`, oldest first."""
        raise NotImplementedError

    def operators(self) -> list[dict[str, Any]]:
        """What each person has done."""
        raise NotImplementedError

    def episodes(self, limit: int = 100) -> list[dict[str, Any]]:
        """Recorded interventions, newest first: {id, robot, operator, began, seconds, outcome, frames}."""
        raise NotImplementedError

    def episode(self, id: int) -> dict[str, Any]:
        """One of them, with "frames": [{t, time, mode, action, wanted, proposed}]."""
        raise NotImplementedError

    def episode_frame(self, id: int, frame: int, width: int = 640, height: int = 360) -> Frame | None:
        """A picture of it. Waits for the renderer, at most a few seconds."""
        raise NotImplementedError

    @property
    def healthy(self) -> dict[str, Any]:
        """{ok, loop, late, learner, restarts, online, recording, policy_version, t}."""
        raise NotImplementedError

    def start(self) -> None:
        """Begin."""
        raise NotImplementedError

    def close(self) -> None:
        """End: robots hold, everything is written down. Waits for it."""
        raise NotImplementedError
