"""What the supervision server tells: who is with which robot and why, as immutable values that any thread may read."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import TutelageError

if TYPE_CHECKING:
    from tutelage.console.controls import Controls

Array = NDArray[Any]

REASONS = ("", "violated", "uncertain", "risky", "novel", "asked")
"""Why a robot needs a person: it fell; its policy is unsure; the critic expects a fall; it has not seen such a state; the
priority says so without saying why, or a person said so. Empty: it needs nobody."""

ENDS = ("given_back", "expired", "handed_over", "reset_done", "offline", "stopped", "violated", "completed", "lost", "ceded")
"""Why a lease ended. completed: the episode ended; lost: the person went away and did not come back in time; ceded: the
algorithm let the robot go on by itself."""


class Denied(TutelageError):
    """What a person asked for is not possible now.

    Attributes:
        code: one of no_seat, not_offered, not_yours, taken, offline, stopped, violated, stale_lease, bad_command, too_many,
            unknown_robot, unknown_person, held.
        text: one line for the person.
    """

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code, self.text = code, text


@dataclass(frozen=True)
class Description:
    """What is supervised, and how.

    Attributes:
        task: its name.
        robots: their names.
        cameras: names of the cameras that each robot has.
        hz: timesteps a second.
        lockstep: whether the simulation waits for the people who hold robots.
        humans: M, seats for operators.
        algorithm: the priority, such as "C.U.R.".
        controls: how people drive.
        t_reset: timesteps of a hard reset.
        hold_after, grace, offer_seconds: see `offers.Terms`: fresh, grace and offer.
    """

    task: str
    robots: tuple[str, ...]
    cameras: tuple[str, ...]
    hz: float
    lockstep: bool
    humans: int
    algorithm: str
    controls: Controls
    t_reset: int = 5
    hold_after: float = 0.5
    grace: float = 5.0
    offer_seconds: float = 15.0

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return {**asdict(self), "controls": self.controls.to_json()}


@dataclass(frozen=True)
class Lease:
    """The right to drive a robot, which one person has at a time.

    Attributes:
        id: a new one for each lease.
        robot: index.
        operator: name of the person.
        since: seconds since 1970.
        reason: why the robot needed somebody, of `REASONS`.
    """

    id: str
    robot: int
    operator: str
    since: float
    reason: str = "asked"


@dataclass(frozen=True)
class Snapshot:
    """The fleet after a timestep. Arrays (N,) are not to be changed.

    Attributes:
        t: completed timesteps.
        time: seconds since 1970.
        mode: the `Mode` of each robot now.
        human: seat of the person who is with each robot, or -1.
        age: timesteps in that mode.
        reason: code of `REASONS` for each robot.
        rank: place in the queue, 0 first, or -1.
        online, stopped: bool; stopped: an emergency stop that nobody cleared yet.
        held: bool, a person has the robot and gives no fresh command, so it stands still.
        queue: requests, first one first: {robot, reason, since (seconds since 1970), offered_to (a name or None), expires_in
            (seconds, or None)}.
        leases: by robot: {operator, id, since, held, reason}.
        policy_version: how often the policy's weights were replaced.
        tick: seconds that the timestep took, without the wait for real robots; late: how much too late it began, s.
    """

    t: int
    time: float
    mode: Array
    human: Array
    age: Array
    reason: tuple[str, ...]
    rank: Array
    online: Array
    stopped: Array
    held: Array
    queue: tuple[dict[str, Any], ...]
    leases: dict[int, dict[str, Any]]
    policy_version: int
    tick: float
    late: float

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        arrays = ("mode", "human", "age", "rank", "online", "stopped", "held")
        return {
            "t": self.t, "time": self.time, "policy_version": self.policy_version, "tick": self.tick, "late": self.late,
            "reason": list(self.reason), "queue": list(self.queue), "leases": {str(k): v for k, v in self.leases.items()},
            **{name: np.asarray(getattr(self, name)).tolist() for name in arrays},
        }  # fmt: skip


@dataclass(frozen=True)
class Frame:
    """A picture. time: when it was taken, seconds since 1970; rgb: (H, W, 3) uint8."""

    time: float
    rgb: NDArray[np.uint8]


@dataclass(frozen=True)
class Told:
    """Something that happened. operator: whom it is for, None: everybody."""

    operator: str | None


@dataclass(frozen=True)
class Stepped(Told):
    """A timestep is complete."""

    snapshot: Snapshot


@dataclass(frozen=True)
class Offer(Told):
    """A robot is offered to a person for so many seconds."""

    robot: int
    reason: str
    expires_in: float


@dataclass(frozen=True)
class LeaseGranted(Told):
    """A person may drive a robot from now on. waited: seconds since the robot asked; answered: since it was offered, None if
    it was taken without an offer."""

    lease: Lease
    waited: float = 0.0
    answered: float | None = None


@dataclass(frozen=True)
class LeaseEnded(Told):
    """A person may not drive a robot any more, and what they did is on the disk. why: one of `ENDS`; seconds: how
    long they had it."""

    robot: int
    lease: str
    why: str
    seconds: float = 0.0


@dataclass(frozen=True)
class Notice(Told):
    """One line for people. level: "info", "warning" or "error"."""

    level: str
    text: str


@dataclass(frozen=True)
class Metrics(Told):
    """A new row of metrics, about once a second."""

    row: dict[str, Any] = field(default_factory=dict)
