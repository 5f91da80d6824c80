"""What is owed to the robots of a fleet: stops that they do not show yet, resets, and the question what they are."""

from __future__ import annotations

import logging
import threading
import time

from tutelage.errors import TutelageError
from tutelage.remote import topics
from tutelage.remote.messages import Ask, Flag, Operation, Stop, StopOperation
from tutelage.remote.robots import Robots
from tutelage.remote.slot import Slot
from tutelage.remote.wire import pack_ask, pack_stop, unpack_answer, unpack_description
from tutelage.sgc.node import Node
from tutelage.sgc.publisher import Publisher
from tutelage.sgc.workers import Workers

log = logging.getLogger(__name__)

TEND = 0.05
ASK_AGAIN = 0.3
STOP_AGAIN = 0.1
"""Seconds between two looks at what is owed to the robots, two requests to one, two messages of the emergency stop."""

ANSWER = 3.0
"""Seconds for which a robot's answer is waited for."""


class Tending:
    """Goes on until it is closed: a thread that looks, and a few that ask.

    Attributes:
        lanes: publishers of the emergency stop, (N,).
    """

    def __init__(self, node: Node, robots: Robots, server: int) -> None:
        """
        Args:
            node: the server's.
            robots: whom to tend.
            server: 64 random bits of this start.
        """
        self.lanes = [node.publisher(topics.alias(slot.name, topics.STOP)) for slot in robots]
        self._node, self._robots, self._server = node, robots, server
        self._asks = self._stops = 0
        self._closed = threading.Event()
        self._pool = Workers("fleet-ask", 8, 4 * len(robots) + 64)
        self._thread = threading.Thread(target=self._tend, name="fleet-tend", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """Leave the robots alone."""
        self._closed.set()
        for lane in self.lanes:
            lane.close()
        self._pool.close()
        if self._thread.ident is not None:
            self._thread.join(2.0)

    def stop(self, robot: int) -> None:
        """Emergency stop: sent at once, and again until the robot shows it."""
        slot = self._robots.slots[robot]
        with self._robots.news:
            slot.stop, slot.clear = True, False
        self._send_stop(robot, StopOperation.STOP)

    def clear(self, robot: int) -> None:
        """End the emergency stop, likewise."""
        slot = self._robots.slots[robot]
        with self._robots.news:
            if not slot.stopped:
                return
            slot.stop, slot.clear = False, True
        self._send_stop(robot, StopOperation.CLEAR)

    def reset(self, slot: Slot, *, soft: bool, seed: int | None) -> None:
        """Ask for a new episode, as soon as the robot can be asked. With the lock held."""
        self._asks += 1
        slot.reset = "soft" if soft else "hard"
        slot.seed, slot.reset_number, slot.accepted, slot.ask_at = seed, self._asks, None, float("-inf")
        slot.was_online = False
        self._robots.news.notify_all()

    def _send_stop(self, robot: int, operation: StopOperation) -> None:
        with self._robots.news:
            self._stops += 1
            message = pack_stop(Stop(self._server, self._stops, operation))
            self._robots.slots[robot].stop_at = time.monotonic()
        send(self._node, self.lanes[robot], message)

    def _tend(self) -> None:
        while not self._closed.is_set():
            now = time.monotonic()
            due: list[tuple[int, StopOperation]] = []
            with self._robots.news:
                for i, slot in enumerate(self._robots):
                    if not self._robots.here(slot, now):
                        continue
                    if now - slot.stop_at >= STOP_AGAIN:
                        if slot.stop and not slot.has(Flag.STOPPED):
                            due.append((i, StopOperation.STOP))
                        elif slot.clear:
                            due.append((i, StopOperation.CLEAR))
                    wanted = slot.description is None or (slot.reset and slot.accepted is None and not slot.stopped)
                    if wanted and not slot.asking and now >= slot.ask_at and not slot.misfit:
                        slot.asking = self._pool.submit(self._ask, slot)
            for i, operation in due:
                self._send_stop(i, operation)
            self._closed.wait(TEND)

    def _ask(self, slot: Slot) -> None:
        """On the pool: what are you, or please reset."""
        try:
            if slot.description is None:
                self._ask_description(slot)
            else:
                self._ask_reset(slot)
        except TutelageError as error:
            log.info("%s: %s", slot.name, error)
        finally:
            with self._robots.news:
                slot.asking, slot.ask_at = False, time.monotonic() + ASK_AGAIN
                self._robots.news.notify_all()

    def _ask_description(self, slot: Slot) -> None:
        boot = slot.newest.boot if slot.newest is not None else 0
        with self._robots.news:
            self._asks += 1
            ask = pack_ask(Ask(self._server, self._asks, Operation.DESCRIBE))
        said = unpack_description(self._node.request(topics.alias(slot.name, topics.SERVICE), ask, ANSWER))
        with self._robots.news:
            if (
                slot.newest is not None and slot.newest.boot == boot
            ):  # else it has started again meanwhile, and is asked again
                self._robots.introduce(slot, said)

    def _ask_reset(self, slot: Slot) -> None:
        with self._robots.news:
            number = slot.reset_number
            operation = Operation.HARD_RESET if slot.reset == "hard" else Operation.SOFT_RESET
            ask = pack_ask(Ask(self._server, number, operation, slot.seed))
        answer = unpack_answer(self._node.request(topics.alias(slot.name, topics.SERVICE), ask, ANSWER))
        with self._robots.news:
            if answer.accepted and slot.reset_number == number:
                slot.accepted = answer
                slot.settle()  # it may have been quicker than its answer


def send(node: Node, publisher: Publisher, message: bytes) -> None:
    """The network may not take it (no certificate any more, closed): robots then hold by themselves."""
    try:
        publisher.send(message)
    except TutelageError as error:
        log.warning("%s: %s", node.name, error)
