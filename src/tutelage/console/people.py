"""People in the loop: a team whose humans are persons, and the allocator that offers robots to them.

`People` is the loop's team and `Desk` its allocator; both stand on one `Offers`, under one lock. What persons send may
arrive at any time from any thread; the loop reads the newest of it when it is about to act and never waits.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.console.controls import Driver
from tutelage.console.offers import NOBODY, Log, Offers
from tutelage.console.reasons import Reasons
from tutelage.console.states import Denied, Lease
from tutelage.fleet.allocation import FleetDAgger
from tutelage.fleet.events import Events
from tutelage.fleet.modes import Event, Mode
from tutelage.fleet.supervisor import Team

Array = NDArray[Any]
Clock = Callable[[], float]


@dataclass
class Command:
    """The newest command for a robot.

    Attributes:
        seq: number, counted by the sender.
        received: when it came, s of the clock.
        lease: under which it came.
        action: (A,) within bounds, or None.
        assist: the algorithmic human acts for the person.
        push: a drag, (x0, y0, x1, y1) on the task's plane, or None.
        uses: timesteps that executed it.
    """

    seq: int
    received: float
    lease: str
    action: Array | None
    assist: bool
    push: tuple[float, float, float, float] | None
    uses: int = 0

    @property
    def silent(self) -> bool:
        """Whether it says that nothing is pressed."""
        return self.action is None and not self.assist and self.push is None


class People(Team):
    """The M persons of a fleet.

    Args:
        offers: who has which robot.
        driver: turns commands into actions.
        lock: guards `offers` and the commands; notified when something arrives that is waited for.
        clock: s, never goes back.
        lockstep: whether each command is for one timestep and stays good until then.
        used: told (operator, seconds from a command's arrival to its first use).
        log: writes commands down, see `Offers`; one that cannot be written down is not kept.
    """

    def __init__(
        self,
        offers: Offers,
        driver: Driver,
        lock: threading.Condition,
        clock: Clock,
        lockstep: bool = False,
        used: Callable[[str, float], None] = lambda operator, seconds: None,
        log: Log = lambda kind, who, robot, **fields: None,
    ) -> None:
        self.offers, self.driver, self.lock, self._clock = offers, driver, lock, clock
        self._log = log
        self._once, self._lockstep, self._used = lockstep or driver.controls.once, lockstep, used
        self.latency = np.zeros(len(offers.seats), dtype=np.int64)
        self.distinct = []
        self.commands: dict[int, Command] = {}
        self.driving: dict[int, Lease] = {}
        """Under which lease each robot was last driven."""
        self.violation: Array = np.zeros(offers.robots, dtype=bool)
        self.frozen = False
        """Whether nobody may drive, because what they do could not be recorded."""

    def __len__(self) -> int:
        return len(self.offers.seats)

    @property
    def pauses(self) -> bool:
        """Robots wait for persons."""
        return True

    def give(
        self, operator: str, robot: int, lease: str, seq: int, action: Sequence[float] | None, assist: bool, push: Any
    ) -> bool:
        """Keep a command. False: a newer one is there already.

        Raises:
            Denied: stale_lease, not_yours or bad_command.
            TutelageError: it cannot be recorded.
        """
        clean = self.driver.check(action)
        drag = self.driver.check_push(push)
        if assist and not self.driver.controls.assist:
            raise Denied("bad_command", "nobody can assist with this task")
        now = self._clock()
        with self.lock:
            hold = self.offers.heard(operator, lease, now)
            if hold.lease.robot != robot:
                raise Denied("not_yours", "this lease is for another robot")
            before = self.commands.get(robot)
            if before and before.lease == lease and seq <= before.seq:
                return False
            command = Command(seq, now, lease, clean, assist, drag)
            if not (command.silent and before and before.silent):
                said = {"action": clean, "assist": assist, "push": drag}
                told = {name: value for name, value in said.items() if value is not None and value is not False}
                self._log("command", operator, robot, lease=lease, seq=seq, **told)
            if not command.silent:
                hold.commanded = now
            self.commands[robot] = command
            if self._lockstep:  # else nobody waits for it
                self.lock.notify_all()
        return True

    # -- the loop's team ----------------------------------------------------------------------------------------

    def ready(self, robots: Array, humans: Array, age: Array) -> Array:
        """Who has accepted; a robot that fell waits until its person asks for the hard reset."""
        with self.lock:
            return np.array(
                [
                    (hold := self.offers.holds.get(r)) is not None
                    and hold.human == j
                    and (hold.reset or not self.violation[r])
                    for r, j in zip(robots.tolist(), humans.tolist(), strict=True)
                ],
                dtype=bool,
            )

    def resets(self, robots: Array, humans: Array) -> Array:
        """Who asked for a hard reset of a robot that has not fallen."""
        with self.lock:
            return np.array(
                [
                    (hold := self.offers.holds.get(r)) is not None and hold.human == j and hold.reset
                    for r, j in zip(robots.tolist(), humans.tolist(), strict=True)
                ],
                dtype=bool,
            )

    def act(self, obs: Array, robots: Array, humans: Array, width: int) -> Array:
        """The persons' newest commands as actions (n, width); NaN for those who say nothing fresh."""
        actions = np.full((len(robots), width), np.nan, dtype=np.float32)
        fresh: list[tuple[int, Command]] = []
        now = self._clock()
        with self.lock:
            for row, (robot, human) in enumerate(zip(robots.tolist(), humans.tolist(), strict=True)):
                command = self._fresh(robot, human, now)
                if command is not None and not self.frozen:
                    fresh.append((row, command))
                    command.uses += 1
                    lease = self.offers.holds[robot].lease
                    self.driving[robot] = lease
                    if command.uses == 1:
                        self._used(lease.operator, now - command.received)
        assisted = [row for row, command in fresh if command.assist]
        if assisted:
            rows = np.array(assisted)
            actions[rows] = self.driver.assist(obs[rows], robots[rows], humans[rows])
        for row, command in fresh:
            if not command.assist:
                action = self.driver.action(command.action, command.push, obs[row], int(robots[row]))
                if action is not None:
                    actions[row] = action
        return actions

    def waiting_for(self) -> list[int]:
        """The robots whose persons are there and have not said what comes next (for lock-step). Call it with the lock."""
        now = self._clock()
        waiting = []
        for robot, hold in self.offers.holds.items():
            seat = self.offers.seats[hold.human]
            away = seat is None or not seat.present or robot in self.offers.offline
            busy = away or hold.resetting or hold.reset or self.violation[robot]
            if not busy and self._fresh(robot, hold.human, now) is None:
                waiting.append(robot)
        return waiting

    def silent(self, robot: int) -> bool:
        """Whether somebody has the robot and says nothing fresh, so that it stands still. Call it with the lock."""
        hold = self.offers.holds.get(robot)
        return hold is not None and not hold.resetting and self._fresh(robot, hold.human, self._clock(), spent=True) is None

    def _fresh(self, robot: int, human: int, now: float, spent: bool = False) -> Command | None:
        hold, command = self.offers.holds.get(robot), self.commands.get(robot)
        if hold is None or hold.human != human or command is None or command.lease != hold.lease.id or command.silent:
            return None
        seat = self.offers.seats[human]
        if seat is None or not seat.present:
            return None
        if not spent and command.uses and (self._once or (command.push is not None and self.driver.pushes)):
            return None
        if not self._lockstep and now - command.received > self.offers.terms.fresh:
            return None
        return command

    def state_dict(self) -> dict[str, Any]:
        """Nothing: leases do not survive the server, and robots hold until somebody takes them again."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing to restore."""


ENDED_BY = {
    Event.VIOLATE: "violated",
    Event.SUCCESS: "completed",
    Event.TIMEOUT: "completed",
    Event.HARD_RESET: "reset_done",
}
"""What ends a lease at the end of a timestep, and why."""


def ended_by(events: Events) -> list[tuple[int, str]]:
    """The robots for which a timestep ends whatever lease there is, and why."""
    found = events.of(*ENDED_BY)
    return [(r, ENDED_BY[Event(e)]) for e, r in zip(found.event.tolist(), found.robot.tolist(), strict=True)]


class Desk(FleetDAgger):
    """The allocator with people: who was offered a robot or has one is with it, in the loop's eyes.

    Args:
        people: the team.
        reasons: the priority of the same loop.
        clock: s, never goes back.
        t_reset: t_R, timesteps of a hard reset.
        gated: whether the priority also decides when a robot needs its person no longer.
    """

    def __init__(self, people: People, reasons: Reasons, clock: Clock, t_reset: int = 5, gated: bool = False) -> None:
        super().__init__(t_teleop=1, t_reset=t_reset)
        self.people, self.reasons, self._clock, self._gated = people, reasons, clock, gated

    def __call__(self, ranks: Array, previous: Array, mode: Array, age: Array, rng: np.random.Generator) -> Array:
        """The robot of each person, (M,) int, or `NOBODY`."""
        offers, now = self.people.offers, self._clock()
        with self.people.lock:
            offers.offline = set(np.flatnonzero(mode == Mode.OFFLINE).tolist())
            for robot in offers.offline:
                if robot in offers.holds or robot in offers.offers:
                    offers.end(robot, "stopped" if robot in offers.stopped else "offline", now)
            offers.resetting = {r: j for j, r in enumerate(previous.tolist()) if r != NOBODY and mode[r] == Mode.RESETTING}
            for robot, hold in list(offers.holds.items()):
                hold.resetting = robot in offers.resetting
                if self._gated and mode[robot] == Mode.TELEOPERATED and not (ranks[robot] > 0).any():
                    offers.end(robot, "ceded", now)
            offers.ask(self.reasons.order, self.reasons.reason, now)
            offers.tick(now)
            robots = np.array(offers.robot_of(), dtype=np.int64)
            for j, robot in enumerate(robots.tolist()):
                if robot != NOBODY and robot not in offers.holds and mode[robot] == Mode.TELEOPERATED:
                    robots[j] = NOBODY  # offered to whom it just was with: released first, as nobody drives by an offer
            return robots
