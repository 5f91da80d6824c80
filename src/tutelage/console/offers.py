"""Who may drive which robot: seats, offers and leases, as a state machine without threads and without a clock of its own.

Robots that need somebody are offered to people who are free, the neediest robot first. A person accepts or declines; who
accepts has a lease, of which there is one a robot and one a person at most. A lease ends when the person gives the robot
back, hands it over, falls silent or goes away, and when the robot falls, completes its episode, is stopped or unreachable.
"""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

from tutelage.console.states import Denied, Lease, LeaseEnded, LeaseGranted, Offer, Told
from tutelage.errors import TutelageError

NOBODY = -1


@dataclass(frozen=True)
class Terms:
    """How long things last, in seconds.

    Attributes:
        offer: until an offer that nobody answers goes to the next person.
        declined: until a robot is offered again to a person who declined it; ignored: to one who did not answer.
        fresh: a command older than this counts no more, and the robot is held.
        grace: a lease ends so long after the person was last heard of.
        idle: a lease ends so long after the last command, whoever is there.
    """

    offer: float = 15.0
    declined: float = 30.0
    ignored: float = 5.0
    fresh: float = 0.5
    grace: float = 5.0
    idle: float = 120.0


@dataclass
class Seat:
    """One of the M places for people. `free_since`: when they last got rid of a robot."""

    operator: str
    present: bool = True
    available: bool = True
    left: float = 0.0
    free_since: float = 0.0
    not_before: dict[int, float] = field(default_factory=dict)


@dataclass
class Asking:
    """A robot that waits for somebody."""

    reason: str
    since: float


@dataclass
class Pending:
    """An offer that is not answered yet."""

    human: int
    since: float
    reason: str


@dataclass
class Hold:
    """A lease, and what was heard of its holder."""

    lease: Lease
    human: int
    since: float
    heard: float
    commanded: float
    reset: bool = False
    resetting: bool = False


Log = Callable[..., None]
"""Called as log(kind, who, robot, **fields) before something happens that must not happen unrecorded; may raise."""


class Offers:
    """The offers and leases of N robots and M seats.

    Times are seconds of any clock that never goes back; `wall` turns one into seconds since 1970. What people ask for and
    cannot have raises `Denied`. `events` collects what is to be told; take it with `take_events`.

    Args:
        robots: N.
        seats: M.
        terms: how long things last.
        log: writes down what happens.
        wall: for the times in leases.
        new_id: makes lease numbers.
    """

    def __init__(
        self,
        robots: int,
        seats: int,
        terms: Terms | None = None,
        log: Log = lambda kind, who, robot, **fields: None,
        wall: Callable[[float], float] = float,
        new_id: Callable[[], str] = lambda: secrets.token_hex(8),
    ) -> None:
        self.robots, self.terms = robots, terms or Terms()
        self.seats: list[Seat | None] = [None] * seats
        self.holds: dict[int, Hold] = {}
        self.offers: dict[int, Pending] = {}
        self.passing: dict[int, Pending] = {}
        """Robots that their holder wants to hand over, and to whom."""
        self.asking: dict[int, Asking] = {}
        self.order: list[int] = []
        """The robots of `asking`, the neediest first."""
        self.left_behind: dict[int, float] = {}
        """Robots whose holder went away or fell silent: somebody should look, whatever the priority says."""
        self.offline: Collection[int] = ()
        self.stopped: set[int] = set()
        self.resetting: dict[int, int] = {}
        """Robots in a hard reset, and the seat that began it: it goes on whatever becomes of the person. The loop says."""
        self._log, self._wall, self._new_id = log, wall, new_id
        self._events: list[Told] = []

    def take_events(self) -> list[Told]:
        """What happened since the last call."""
        events, self._events = self._events, []
        return events

    # -- people come and go -------------------------------------------------------------------------------------

    def join(self, operator: str, now: float) -> int:
        """The person's seat: the one they had, else a new one, else that of somebody who is gone."""
        j = self._find(operator)
        if j is None:
            gone = [k for k, s in enumerate(self.seats) if s is None or not (s.present or self._busy(k))]
            if not gone:
                raise Denied("no_seat", f"all {len(self.seats)} seats are taken")
            j = min(gone, key=lambda k: -1.0 if self.seats[k] is None else self.seats[k].left)  # type: ignore[union-attr]
            self.seats[j] = Seat(operator, free_since=now)
        seat = self._seat(j)
        if not seat.present:
            seat.present, seat.available = True, True
        return j

    def leave(self, operator: str, now: float) -> None:
        """The person is gone. Their robot is held; the lease ends after the grace period."""
        j = self._find(operator)
        if j is not None and self._seat(j).present:
            seat = self._seat(j)
            seat.present, seat.left = False, now
            self._withdraw(j)

    def available(self, operator: str, yes: bool, now: float) -> None:
        """Whether the person wants offers."""
        j = self._mine(operator)
        self._seat(j).available = yes
        if not yes:
            self._withdraw(j)

    # -- offers and leases --------------------------------------------------------------------------------------

    def accept(self, operator: str, robot: int, now: float) -> Lease:
        """Take an offered robot, or one that its holder hands over. Whoever has it already keeps it."""
        j = self._mine(operator)
        self._check(robot)
        if robot in self.holds and self.holds[robot].human == j:
            return self.holds[robot].lease
        passing = self.passing.get(robot)
        if passing and passing.human == j and robot in self.holds and not self.holds[robot].reset:
            reason = self.holds[robot].lease.reason
            self._log("hand_over", operator, robot, giver=self.holds[robot].lease.operator)
            self._end(robot, "handed_over", now)
            return self._grant(j, robot, reason, now)
        if robot in self.holds or robot in self.resetting:
            raise Denied("taken", f"{self._holder(robot)} has this robot")
        offer = self.offers.get(robot)
        if offer is None or offer.human != j:
            raise Denied("not_offered", "this robot is not offered to you any more")
        return self._grant(j, robot, offer.reason, now)

    def decline(self, operator: str, robot: int, now: float) -> None:
        """Leave a robot to others."""
        j = self._mine(operator)
        self._check(robot)
        for pending in (self.offers, self.passing):
            if robot in pending and pending[robot].human == j:
                self._log("decline", operator, robot)
                del pending[robot]
                self._seat(j).not_before[robot] = now + self.terms.declined
                return
        raise Denied("not_offered", "this robot is not offered to you any more")

    def take(self, operator: str, robot: int, now: float) -> Lease:
        """Take a robot that nobody holds, offered or not."""
        j = self._mine(operator)
        self._check(robot)
        if robot in self.stopped:
            raise Denied("stopped", "this robot is stopped; clear the emergency stop first")
        if robot in self.offline:
            raise Denied("offline", "this robot is out of reach")
        if robot in self.holds or robot in self.resetting:
            raise Denied("taken", f"{self._holder(robot)} has this robot")
        if self._busy(j):
            raise Denied("too_many", "give back the robot that you have first")
        asking = self.asking.get(robot)
        return self._grant(j, robot, asking.reason if asking else "asked", now)

    def give_back(self, operator: str, robot: int, now: float) -> None:
        """End one's lease."""
        self._held_by(operator, robot)
        self._end(robot, "given_back", now)

    def hand_over(self, operator: str, robot: int, to: str, now: float) -> None:
        """Offer one's robot to a certain person."""
        hold = self._held_by(operator, robot)
        if hold.reset:
            raise Denied("taken", "its hard reset is yours to the end")
        k = self._find(to)
        if k is None or not self._seat(k).present:
            raise Denied("unknown_person", f"{to} is not here")
        if k == hold.human or self._busy(k):
            raise Denied("too_many", f"{to} has a robot already")
        self._withdraw(k)
        self.passing[robot] = Pending(k, now, hold.lease.reason)
        self._events.append(Offer(to, robot, hold.lease.reason, self.terms.offer))

    def reset(self, operator: str, robot: int, now: float) -> None:
        """Ask for a hard reset of one's robot."""
        hold = self._held_by(operator, robot)
        if not hold.reset:
            self._log("reset", operator, robot, lease=hold.lease.id)
        hold.reset, hold.heard, hold.commanded = True, now, now

    def heard(self, operator: str, lease: str, now: float, command: bool = False) -> Hold:
        """The person with that lease is there (and gave a command)."""
        j = self._find(operator)
        for hold in self.holds.values():
            if hold.lease.id == lease:
                if hold.human != j:
                    break
                hold.heard = now
                if command:
                    hold.commanded = now
                return hold
        raise Denied("stale_lease", "this lease is over")

    # -- robots -------------------------------------------------------------------------------------------------

    def stop(self, robots: Collection[int], now: float) -> None:
        """An emergency stop: whoever has these robots loses them."""
        self.stopped |= set(robots)
        for robot in robots:
            self.end(robot, "stopped", now)

    def clear(self, robots: Collection[int]) -> None:
        """The emergency stop is over."""
        self.stopped -= set(robots)

    def end(self, robot: int, why: str, now: float) -> None:
        """Whatever there is about a robot ends: its lease, an offer. A hard reset goes on until the loop says it is done."""
        self.offers.pop(robot, None)
        self.left_behind.pop(robot, None)
        if robot in self.holds:
            self._end(robot, why, now)
        if why == "reset_done":
            self.resetting.pop(robot, None)

    def ask(self, order: Sequence[int], reasons: Sequence[str], now: float) -> None:
        """These robots need somebody, the neediest first (of equal ones, whoever has waited longest is to be first).

        An offer stays as it is when its robot does not ask any more.
        """
        reason_of = dict(zip(order, reasons, strict=True))
        late = {r: pending.reason for r, pending in self.offers.items() if r not in reason_of}
        self.order = [r for r in [*order, *late] if self._can_wait(r)]
        before, reason_of = self.asking, {**late, **reason_of}
        self.asking = {
            r: Asking(reason_of[r], before[r].since if r in before else self.left_behind.get(r, now)) for r in self.order
        }

    def tick(self, now: float) -> None:
        """Time passes: offers and leases run out, and robots that wait are offered to people who are free."""
        for pending in (self.offers, self.passing):
            for robot, offer in list(pending.items()):
                if now - offer.since >= self.terms.offer:
                    del pending[robot]
                    self._seat(offer.human).not_before[robot] = now + self.terms.ignored
        for robot, hold in list(self.holds.items()):
            seat = self._seat(hold.human)
            silent = now - (min(hold.heard, seat.left) if not seat.present else hold.heard) >= self.terms.grace
            if (silent or now - hold.commanded >= self.terms.idle) and not hold.resetting:
                self._end(robot, "expired" if seat.present else "lost", now)
                self.left_behind[robot] = now
        self._offer(now)

    def _offer(self, now: float) -> None:
        free = [j for j, seat in enumerate(self.seats) if seat and seat.present and seat.available and not self._engaged(j)]
        free.sort(key=lambda j: self._seat(j).free_since)
        for robot in self.order:
            if not free:
                return
            if robot in self.offers or robot in self.holds:
                continue
            willing = [j for j in free if self._seat(j).not_before.get(robot, now) <= now]
            if willing:
                j = willing[0]
                free.remove(j)
                reason = self.asking[robot].reason
                with contextlib.suppress(TutelageError):  # an offer does nothing yet
                    self._log("offer", self._seat(j).operator, robot, reason=reason)
                self.offers[robot] = Pending(j, now, reason)
                self._events.append(Offer(self._seat(j).operator, robot, reason, self.terms.offer))

    # -- reading ------------------------------------------------------------------------------------------------

    def robot_of(self) -> list[int]:
        """The robot that is offered or leased to each seat, or in a hard reset by it, (M,), or `NOBODY`."""
        robots = [NOBODY] * len(self.seats)
        for robot, j in self.resetting.items():
            robots[j] = robot
        for robot, offer in self.offers.items():
            robots[offer.human] = robot
        for robot, hold in self.holds.items():
            robots[hold.human] = robot
        return robots

    def queue(self, now: float) -> list[dict[str, Any]]:
        """The requests, first one first. expires_in: seconds, of those that are offered to somebody."""
        rows = []
        for robot in self.order:
            asking, offer = self.asking[robot], self.offers.get(robot)
            to = self._seat(offer.human).operator if offer else None
            left = max(0.0, self.terms.offer - (now - offer.since)) if offer else None
            row = {"robot": robot, "reason": asking.reason, "since": self._wall(asking.since)}
            rows.append({**row, "offered_to": to, "expires_in": left})
        return rows

    def standing(self, operator: str, now: float) -> list[Told]:
        """What somebody who comes back must be told again: their lease, and what is offered to them."""
        j = self._find(operator)
        told: list[Told] = [LeaseGranted(operator, hold.lease) for hold in self.holds.values() if hold.human == j]
        for pending in (self.offers, self.passing):
            for robot, offer in pending.items():
                if offer.human == j:
                    told.append(Offer(operator, robot, offer.reason, max(0.0, self.terms.offer - (now - offer.since))))
        return told

    # -- inside -------------------------------------------------------------------------------------------------

    def _grant(self, j: int, robot: int, reason: str, now: float) -> Lease:
        seat = self._seat(j)
        lease = Lease(self._new_id(), robot, seat.operator, self._wall(now), reason)
        asking, offer = self.asking.get(robot), self.offers.get(robot)
        waited = now - asking.since if asking else 0.0
        answered = now - offer.since if offer and offer.human == j else None
        self._log("lease", seat.operator, robot, lease=lease.id, reason=reason, waited=round(waited, 3))
        self._withdraw(j)
        for pending in (self.offers, self.passing, self.left_behind, self.asking):
            pending.pop(robot, None)
        self.order = [r for r in self.order if r != robot]
        self.holds[robot] = Hold(lease, j, now, now, now)
        self._events.append(LeaseGranted(seat.operator, lease, waited, answered))
        return lease

    def _end(self, robot: int, why: str, now: float) -> None:
        hold = self.holds.pop(robot)
        self.passing.pop(robot, None)
        self._seat(hold.human).free_since = now
        if hold.reset:  # it may have begun in the timestep that is going on; the loop will tell
            self.resetting[robot] = hold.human
        with contextlib.suppress(TutelageError):  # it ends in any case
            self._log("lease_end", hold.lease.operator, robot, lease=hold.lease.id, why=why)
        self._events.append(LeaseEnded(hold.lease.operator, robot, hold.lease.id, why, now - hold.since))

    def _withdraw(self, j: int) -> None:
        """Nothing is offered to the person any more."""
        for pending in (self.offers, self.passing):
            for robot in [r for r, offer in pending.items() if offer.human == j]:
                del pending[robot]

    def _can_wait(self, robot: int) -> bool:
        return not (robot in self.holds or robot in self.resetting or robot in self.stopped or robot in self.offline)

    def _busy(self, j: int) -> bool:
        """Whether the person has a robot."""
        return j in self.resetting.values() or any(hold.human == j for hold in self.holds.values())

    def _engaged(self, j: int) -> bool:
        """Whether they have one, or were offered one."""
        return self._busy(j) or any(o.human == j for p in (self.offers, self.passing) for o in p.values())

    def _find(self, operator: str) -> int | None:
        return next((j for j, seat in enumerate(self.seats) if seat and seat.operator == operator), None)

    def _seat(self, j: int) -> Seat:
        seat = self.seats[j]
        assert seat is not None
        return seat

    def _mine(self, operator: str) -> int:
        j = self._find(operator)
        if j is None or not self._seat(j).present:
            raise Denied("no_seat", "take a seat first")
        return j

    def _check(self, robot: int) -> None:
        if not 0 <= robot < self.robots:
            raise Denied("unknown_robot", f"there is no robot {robot}")

    def _held_by(self, operator: str, robot: int) -> Hold:
        j = self._mine(operator)
        self._check(robot)
        hold = self.holds.get(robot)
        if hold is None or hold.human != j:
            raise Denied("not_yours", "you do not have this robot")
        return hold

    def _holder(self, robot: int) -> str:
        hold = self.holds.get(robot)
        return hold.lease.operator if hold else "somebody"
