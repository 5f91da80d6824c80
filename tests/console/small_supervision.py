"""A supervision without robots: points that people may take, in one thread. For tests of the web application only."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tutelage.console.audit import Audit
from tutelage.console.controls import Controls
from tutelage.console.supervision import (
    Denied,
    Description,
    Frame,
    Lease,
    LeaseEnded,
    LeaseGranted,
    Notice,
    Offer,
    Snapshot,
    Stepped,
    Supervision,
    Told,
)


class SmallSupervision(Supervision):
    """Seats, one lease a robot, commands that are kept in `commands`; a robot is offered by `offer`."""

    def __init__(self, audit: Audit, robots: int = 4, humans: int = 2, hz: float = 20.0) -> None:
        self.description = Description(
            "Points", tuple(f"point-{i}" for i in range(robots)), ("front", "side"), hz, False, humans, "C.U.R.",
            Controls(axes=(), pointer=None, assist=True, help="drive"),
        )  # fmt: skip
        self.audit, self.n = audit, robots
        self.commands: list[tuple[Any, ...]] = []
        self.calls: list[tuple[Any, ...]] = []
        self.seats: dict[str, int] = {}
        self.leases: dict[int, Lease] = {}
        self.offered: dict[int, str] = {}
        self.stopped = np.zeros(robots, dtype=bool)
        self.shape = (180, 320)
        self.sent = b""
        self._lock = threading.RLock()
        self._told: list[Callable[[Told], None]] = []
        self._ids = itertools.count(1)
        self._t = 0
        self._running = False

    def tell(self, event: Told) -> None:
        for callback in list(self._told):
            callback(event)

    def offer(self, robot: int, operator: str) -> None:
        self.offered[robot] = operator
        self.tell(Offer(operator, robot, "uncertain", 10.0))

    def note(self, operator: str, what: str, robot: int | None, **fields: Any) -> None:
        self.calls.append((operator, what, robot))
        self.audit.write(what, operator, robot, **fields)

    def join(self, operator: str) -> int:
        with self._lock:
            if operator not in self.seats:
                free = set(range(self.description.humans)) - set(self.seats.values())
                if not free:
                    raise Denied("no_seat", "all seats are taken")
                self.seats[operator] = min(free)
            self.note(operator, "join", None)
            return self.seats[operator]

    def leave(self, operator: str) -> None:
        with self._lock:
            self.note(operator, "leave", None)
            self.seats.pop(operator, None)
            for robot, lease in list(self.leases.items()):
                if lease.operator == operator:
                    self._finish(robot, "lost")

    def standing(self, operator: str) -> list[Told]:
        with self._lock:
            mine: list[Told] = [
                LeaseGranted(operator, lease) for lease in self.leases.values() if lease.operator == operator
            ]
            return mine + [Offer(operator, robot, "uncertain", 5.0) for robot, to in self.offered.items() if to == operator]

    def available(self, operator: str, yes: bool) -> None:
        self.note(operator, "available", None, yes=yes)

    def accept(self, operator: str, robot: int) -> Lease:
        with self._lock:
            if self.offered.get(robot) != operator:
                raise Denied("not_offered", f"robot {robot} is not offered to you")
            del self.offered[robot]
            return self._lease(operator, robot)

    def decline(self, operator: str, robot: int) -> None:
        with self._lock:
            if self.offered.pop(robot, None) != operator:
                raise Denied("not_offered", f"robot {robot} is not offered to you")
            self.note(operator, "decline", robot)

    def take(self, operator: str, robot: int) -> None:
        self._known(robot)
        with self._lock:
            if robot in self.leases:
                raise Denied("taken", f"robot {robot} is with {self.leases[robot].operator}")
            self._lease(operator, robot)

    def give_back(self, operator: str, robot: int) -> None:
        with self._lock:
            self._mine(operator, robot)
            self.note(operator, "give_back", robot)
            self._finish(robot, "given_back")

    def hand_over(self, operator: str, robot: int, to: str) -> None:
        with self._lock:
            self._mine(operator, robot)
            if to not in self.seats:
                raise Denied("unknown_person", f"{to} is not here")
            self.offer(robot, to)

    def reset(self, operator: str, robot: int) -> None:
        with self._lock:
            self._mine(operator, robot)
            self.note(operator, "reset", robot)

    def command(
        self,
        operator: str,
        robot: int,
        lease: str,
        seq: int,
        action: Sequence[float] | None,
        assist: bool = False,
        push: Sequence[float] | None = None,
    ) -> bool:
        with self._lock:
            self._mine(operator, robot)
            if self.leases[robot].id != lease:
                raise Denied("stale_lease", "that lease is over")
            self.commands.append((operator, robot, seq, action, assist, push))
            return True

    def renew(self, operator: str, lease: str) -> None:
        if not any(held.id == lease and held.operator == operator for held in self.leases.values()):
            raise Denied("stale_lease", "that lease is over")

    def estop(self, operator: str, robot: int | None) -> None:
        self.stopped[slice(None) if robot is None else self._known(robot)] = True
        self.note(operator, "estop", robot)

    def clear_estop(self, operator: str, robot: int | None) -> None:
        self.stopped[slice(None) if robot is None else self._known(robot)] = False
        self.note(operator, "estop_clear", robot)

    def snapshot(self) -> Snapshot:
        with self._lock:
            zeros = np.zeros(self.n, dtype=int)
            leases = {
                robot: {"operator": lease.operator, "id": lease.id, "since": lease.since, "held": False}
                for robot, lease in self.leases.items()
            }
            queue = tuple(
                {"robot": robot, "reason": "uncertain", "since": 0.0, "offered_to": to} for robot, to in self.offered.items()
            )
            return Snapshot(
                self._t, time.time(), zeros, zeros - 1, zeros, ("",) * self.n, zeros - 1, zeros == 0, self.stopped.copy(),
                zeros > 0, queue, leases, 0, 0.001, 0.0,
            )  # fmt: skip

    def subscribe(self, callback: Callable[[Told], None]) -> Callable[[], None]:
        self._told.append(callback)
        return lambda: self._told.remove(callback)

    def frame(self, robot: int, camera: int, width: int, height: int) -> Frame | None:
        picture = np.full((*self.shape, 3), (40 * robot, 100, 200), dtype=np.uint8)
        return Frame(self._t / self.description.hz, picture)

    def jpeg(self, robot: int, camera: int) -> tuple[float, bytes] | None:
        return (self._t / self.description.hz, self.sent) if self.sent else None

    def metrics(self, since: int = 0) -> list[dict[str, Any]]:
        return [{"t": t, "successes": t // 10, "rohe": float("nan")} for t in range(since + 1, self._t + 1)]

    def operators(self) -> list[dict[str, Any]]:
        return [{"operator": name, "interventions": 0} for name in list(self.seats)[:1]]

    def episodes(self, limit: int = 100) -> list[dict[str, Any]]:
        return [{"id": 1, "robot": 0, "operator": "ana", "began": 0.0, "seconds": 1.0, "outcome": "given_back", "frames": 2}]

    def episode(self, id: int) -> dict[str, Any] | None:
        if id != 1:
            return None
        return self.episodes()[0] | {"frames": [{"t": 0, "wanted": np.array([np.nan, 1.0])}]}

    def episode_frame(self, id: int, frame: int, width: int = 640, height: int = 360) -> Frame | None:
        return self.frame(0, 0, width, height) if (id, frame) == (1, 0) else None

    @property
    def healthy(self) -> dict[str, Any]:
        return {"ok": self._running, "late": 0.0, "online": self.n}

    def start(self) -> None:
        self._running = True
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._running = False
        self._thread.join()

    def _run(self) -> None:
        while self._running:
            self._t += 1
            self.tell(Stepped(None, self.snapshot()))
            if self._t == 2:
                self.tell(Notice(None, "info", "begun"))
            time.sleep(1 / self.description.hz)

    def _known(self, robot: int) -> int:
        if not 0 <= robot < self.n:
            raise Denied("unknown_robot", f"no robot {robot}")
        return robot

    def _mine(self, operator: str, robot: int) -> None:
        if robot not in self.leases or self.leases[robot].operator != operator:
            raise Denied("not_yours", f"robot {robot} is not yours")

    def _lease(self, operator: str, robot: int) -> Lease:
        lease = Lease(f"lease-{next(self._ids)}", robot, operator, time.time())
        self.leases[robot] = lease
        self.note(operator, "lease", robot, lease=lease.id)
        self.tell(LeaseGranted(operator, lease))
        return lease

    def _finish(self, robot: int, why: str) -> None:
        lease = self.leases.pop(robot)
        self.tell(LeaseEnded(lease.operator, robot, lease.id, why))
