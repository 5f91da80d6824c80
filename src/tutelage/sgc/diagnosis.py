"""Why a node hears nothing: no router, one that does not know it, an owner that is silent. Said once, with the remedy.

A router lets pass only what its copy of the policy allows, and drops the rest in silence. So nodes ask it which of their
topics it knows: they send their pseudonym and names, which it sees anyway, and get a byte for each. The answer is not
trusted and changes nothing but what is logged and what `/healthz` says.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable

from tutelage.sgc import lanes
from tutelage.sgc.access import Access, Route
from tutelage.sgc.home import Home
from tutelage.sgc.transport.base import NoReply, Transport
from tutelage.sgc.workers import Workers

log = logging.getLogger(__name__)

PATIENCE = 3.0
"""Seconds for which something must be amiss before it is said."""

AGAIN = 2.5
"""Seconds between two questions to a router that gave no good answer."""

_TIMEOUT = 2.0
_PSEUDONYM, _NAME = 32, 32
_MOST = 4096  # names of a question
_SHOWN = 5  # aliases in a message


def question(access: Access, pseudonym: str) -> bytes:
    """What a node asks: its pseudonym, and the names of its topics in the order of their aliases."""
    names = [access.topics[alias].name for alias in sorted(access.topics)][:_MOST]
    return pseudonym.encode() + b"".join(map(bytes, names))


def answer(asked: bytes, routes: Iterable[Route]) -> bytes | None:
    """What a router answers: for each name 1 if the node has a part in it, else 0. None to what is no question."""
    names = asked[_PSEUDONYM:]
    if len(asked) < _PSEUDONYM or len(names) % _NAME or len(names) > _MOST * _NAME:
        return None
    who = asked[:_PSEUDONYM].decode("ascii", "replace")
    known = {bytes(route.name) for route in routes if who in route.send | route.receive | {route.owner}}
    return bytes(names[at : at + _NAME] in known for at in range(0, len(names), _NAME))


class Diagnosis:
    """Looks after one node. `look` is called now and then, on one thread; `problems` may be read on any."""

    def __init__(self, home: Home, transport: Transport, pool: Workers, lacking: Callable[[], list[str]]) -> None:
        """
        Args:
            pool: where questions to the router wait for their answers.
            lacking: aliases of topics without a key.
        """
        self._home, self._transport, self._pool, self._lacking = home, transport, pool, lacking
        self._lock = threading.Lock()
        self._since: dict[str, float] = {}
        self._said: set[str] = set()
        self._unknown: list[str] | None = []  # aliases that the router does not know; None: it gave no answer
        self._asked_for: tuple[int, bool] = (-1, False)
        self._ask_at = 0.0

    def problems(self) -> list[str]:
        """What has been amiss for a while; each names the node or topic, and the remedy."""
        with self._lock:
            return sorted(self._said)

    def look(self, now: float | None = None) -> None:
        """Look, and log what is new. now: seconds of a clock that does not jump."""
        now = time.monotonic() if now is None else now
        connected = self._transport.connected
        self._ask(now, connected)
        found = self._found(connected)
        with self._lock:
            self._since = {problem: self._since.get(problem, now) for problem in found}
            ripe = {problem for problem, since in self._since.items() if now - since >= PATIENCE}
            news, gone = ripe - self._said, self._said - set(found)
            self._said = (self._said | ripe) & set(found)
        for problem in sorted(news):
            log.warning("%s", problem)
        if gone and not found:
            log.warning("%s: all is well again", self._home.name)

    def _found(self, connected: bool) -> list[str]:
        name = self._home.name
        if not connected:
            return [
                f"{name} reaches none of the routers of its network.toml, and goes on trying: do they run, at an "
                "address that their certificate names (tutelage keys init --router NAME --address ADDRESS)?"
            ]
        with self._lock:
            unknown = self._unknown
        remedy = "give it the newest bundle: tutelage keys renew ROUTER --bundle FLEET/outbox/ROUTER.bundle"
        if unknown is None:
            return [f"{name} is connected to a router that does not let it speak, as it does not know it; {remedy}"]
        found = []
        if unknown:
            found.append(f"the router of {name} has an older policy, without its part in {_some(unknown)}; {remedy}")
        without: dict[str, list[str]] = {}
        for alias in set(self._lacking()) - set(unknown):
            without.setdefault(self._home.access.entry(alias).rule.owner, []).append(alias)
        for owner, aliases in without.items():
            found.append(f"{name} has no key of {_some(aliases)}, as {owner}, who owns it, does not answer: does it run?")
        return found

    def _ask(self, now: float, connected: bool) -> None:
        """Ask the router, if there is a new connection, a new policy, or no good answer yet."""
        state = (self._home.version, connected)
        with self._lock:
            if state != self._asked_for:
                self._asked_for, self._ask_at, self._unknown = state, now, []
            if not (connected and self._transport.routed) or now < self._ask_at:
                return
            self._ask_at = now + AGAIN
        self._pool.submit(self._question, state)

    def _question(self, state: tuple[int, bool]) -> None:
        access, unknown = self._home.access, None
        try:
            key = lanes.key(access.control, lanes.RULES)
            reply = self._transport.request(key, question(access, self._home.pseudonym), _TIMEOUT)
            unknown = [alias for alias, known in zip(sorted(access.topics), reply, strict=False) if not known]
        except NoReply:
            pass
        with self._lock:
            if state == self._asked_for:
                self._unknown = unknown
                if unknown == []:
                    self._ask_at = float("inf")


def _some(aliases: list[str]) -> str:
    shown = sorted(aliases)[:_SHOWN]
    return ", ".join(shown) + (f" and {len(aliases) - _SHOWN} more" if len(aliases) > _SHOWN else "")
