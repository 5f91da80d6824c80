"""Who is present, by name and verified: a token under a topic's name says that somebody is there, a sealed echo says who.

Anybody who carries our packets can invent a token; the answer to a ping is sealed and signed, so names are never invented.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from tutelage.errors import TutelageError
from tutelage.sgc import lanes
from tutelage.sgc.access import Entry, Lane
from tutelage.sgc.directory import Directory
from tutelage.sgc.keyring import Keyring
from tutelage.sgc.sealing import Opener, Sealer
from tutelage.sgc.service import Requester, Server
from tutelage.sgc.transport.base import Handle, NoReply, Transport
from tutelage.sgc.workers import Workers


@dataclass(frozen=True)
class Peer:
    """Another node that is present.

    Attributes:
        name: of the node, verified.
        topics: aliases of topics that it shares with us.
        round_trip: seconds of the last ping.
    """

    name: str
    topics: tuple[str, ...]
    round_trip: float


class Presence:
    """This node's own tokens and echoes, and those of others on the topics that it shares with them."""

    def __init__(
        self, keyring: Keyring, pseudonym: str, transport: Transport, need_key: Callable[[], None], pool: Workers
    ) -> None:
        """
        Args:
            need_key: called when the key of a topic is missing.
            pool: where pings wait for their answers.
        """
        self.directory = Directory(transport)
        self._keyring, self._pseudonym, self._transport = keyring, pseudonym, transport
        self._need_key, self._pool = need_key, pool
        self._lock = threading.Lock()
        self._topics: dict[str, Entry] = {}
        self._known: dict[str, tuple[str, float]] = {}  # pseudonym -> name, round trip in seconds
        self._requesters: dict[tuple[str, str], Requester] = {}

    def join(self, alias: str, entry: Entry) -> list[Handle]:
        """Be present on a topic, answer pings there, and see who else does, until the handles are closed."""
        server = Server(alias, *self._ends(alias), lambda asked: asked.payload)
        handles = [
            self._transport.serve(lanes.key(entry.name, lanes.ECHO, self._pseudonym), server.answer),
            self.directory.publish(entry.name, self._pseudonym),
        ]
        self.directory.subscribe(entry.name)
        with self._lock:
            self._topics[alias] = entry
        return handles

    def leave(self, alias: str) -> None:
        """Do not look for others on a topic any more."""
        with self._lock:
            self._topics.pop(alias, None)
            self._requesters = {key: each for key, each in self._requesters.items() if key[0] != alias}

    def peers(self, timeout: float) -> list[Peer]:
        """Who is there and answers; those met for the first time are asked who they are, for at most `timeout` seconds."""
        present = self._present()
        strangers = {who: aliases[0] for who, aliases in present.items() if who not in self._known}
        met = threading.Semaphore(0)
        asked = sum(self._pool.submit(self._meet, who, alias, timeout, met) for who, alias in strangers.items())
        until = time.monotonic() + timeout
        for _ in range(asked):
            met.acquire(timeout=max(0.0, until - time.monotonic()))
        with self._lock:
            known = {who: self._known[who] for who in present if who in self._known}
        return sorted(
            (Peer(name, tuple(present[who]), took) for who, (name, took) in known.items()), key=lambda peer: peer.name
        )

    def ping(self, name: str, timeout: float) -> float:
        """The round trip to a node, sealed and verified, in seconds.

        Raises:
            NoReply: no such node is present, or it does not answer in time.
        """
        until = time.monotonic() + timeout
        while True:
            for who, aliases in self._present().items():
                if who not in self._known:
                    self._meet(who, aliases[0], max(0.01, until - time.monotonic()))
                if self._known.get(who, ("", 0.0))[0] == name:
                    return self._echo(who, aliases[0], max(0.01, until - time.monotonic()))[1]
            if time.monotonic() >= until:
                raise NoReply(f"no node {name} is present on a topic that it shares with us")
            time.sleep(0.05)

    def close(self) -> None:
        """Look for nobody any more."""
        self.directory.close()

    def _ends(self, alias: str) -> tuple[Sealer, Opener]:
        return Sealer(self._keyring, alias, Lane.PRESENCE), Opener(self._keyring, alias, Lane.PRESENCE)

    def _present(self) -> dict[str, list[str]]:
        """Aliases by pseudonym."""
        present: dict[str, list[str]] = {}
        with self._lock:
            topics = dict(self._topics)
        for alias, entry in topics.items():
            for who in self.directory.present(entry.name) - {self._pseudonym}:
                present.setdefault(who, []).append(alias)
        return present

    def _meet(self, who: str, alias: str, timeout: float, met: threading.Semaphore | None = None) -> None:
        with contextlib.suppress(TutelageError):  # not there any more, or a token that somebody invented
            self._echo(who, alias, timeout)
        if met is not None:
            met.release()

    def _echo(self, who: str, alias: str, timeout: float) -> tuple[str, float]:
        with self._lock:
            requester = self._requesters.get((alias, who))
            if requester is None:
                sealer, opener = self._ends(alias)
                key = lanes.key(self._topics[alias].name, lanes.ECHO, who)
                requester = Requester(alias, key, sealer, opener, self._transport, self._need_key)
                self._requesters[alias, who] = requester
        start = time.perf_counter()
        reply = requester.request(b"", timeout)
        took = time.perf_counter() - start
        with self._lock:
            self._known[who] = (reply.sender, took)
        return reply.sender, took
