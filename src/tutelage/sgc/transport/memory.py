"""The network in one process: for tests, and for programs whose nodes share a process. No socket, no thread of its own.

A packet is delivered on the thread that publishes it, before `publish` returns. `Network.tap` puts an attacker on the wire.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import TypeVar

from tutelage.sgc.transport.base import Handle, NoReply, Transport, check_key, matches

T = TypeVar("T")
Tap = Callable[[str, bytes], Iterable[tuple[str, bytes]]]
"""What a router does with a packet: takes key and payload, returns what is delivered in its place."""

Rewrite = Callable[[str, bytes], bytes | None]
"""What a router does with a request or an answer: takes key and payload, returns another payload; None: dropped."""


class Network:
    """A wire that joins the transports made with it."""

    def __init__(self, tap: Tap | None = None) -> None:
        self.tap = tap
        self.ask_tap: Rewrite | None = None
        """The same for requests."""
        self.answer_tap: Rewrite | None = None
        """The same for the answers to them."""
        self.up = True
        """False: nobody is connected; packets are lost and requests are not answered."""
        self.lock = threading.RLock()
        self.subscribers: dict[object, tuple[str, Callable[[bytes], None]]] = {}
        self.servers: dict[object, tuple[str, Callable[[bytes], bytes | None]]] = {}
        self.present: dict[object, str] = {}
        self.watchers: dict[object, tuple[str, Callable[[str, bool], None]]] = {}

    def carry(self, key: str, payload: bytes) -> None:
        """Through the tap, to whoever listens."""
        if self.up:
            for where, packet in [(key, payload)] if self.tap is None else list(self.tap(key, payload)):
                self.deliver(where, packet)

    def deliver(self, key: str, payload: bytes) -> None:
        """To whoever listens, past the tap."""
        with self.lock:
            listening = [call for pattern, call in self.subscribers.values() if matches(pattern, key)]
        for call in listening:
            call(payload)

    def tell(self, key: str, present: bool) -> None:
        """Those who watch that somebody came or went."""
        with self.lock:
            watching = [call for pattern, call in self.watchers.values() if matches(pattern, key)]
        for call in watching:
            call(key, present)


class MemoryTransport(Transport):
    """A transport on a `Network`."""

    routed = False

    def __init__(self, network: Network) -> None:
        self.network = network
        self._handles: set[Handle] = set()

    @property
    def connected(self) -> bool:
        return self.network.up

    def publish(self, key: str, payload: bytes | bytearray, *, reliable: bool = True) -> None:
        self.network.carry(check_key(key), bytes(payload))

    def subscribe(self, key: str, on_packet: Callable[[bytes], None]) -> Handle:
        return self._add(self.network.subscribers, (check_key(key, wildcard=True), on_packet))

    def serve(self, key: str, on_request: Callable[[bytes], bytes | None], *, slow: bool = False) -> Handle:
        return self._add(self.network.servers, (check_key(key), on_request))

    def request(self, key: str, payload: bytes | bytearray, timeout: float) -> bytes:
        with self.network.lock:
            serving = [call for pattern, call in self.network.servers.values() if matches(pattern, check_key(key))]
        asked: bytes | None = bytes(payload)
        if asked is not None and self.network.ask_tap is not None:
            asked = self.network.ask_tap(key, asked)
        for call in serving:
            reply = call(asked) if self.network.up and asked is not None else None
            if reply is not None and self.network.answer_tap is not None:
                reply = self.network.answer_tap(key, reply)
            if reply is not None:
                return reply
        raise NoReply(f"nobody answered within {timeout:g} s")

    def announce(self, key: str) -> Handle:
        token = object()
        with self.network.lock:
            news = check_key(key) not in self.network.present.values()
            self.network.present[token] = key
        if news:
            self.network.tell(key, True)

        def leave() -> None:
            with self.network.lock:
                self.network.present.pop(token, None)
                gone = key not in self.network.present.values()
            if gone:
                self.network.tell(key, False)

        return self._keep(Handle(leave))

    def watch(self, key: str, on_change: Callable[[str, bool], None]) -> Handle:
        with self.network.lock:
            handle = self._add(self.network.watchers, (check_key(key, wildcard=True), on_change))
            there = {token for token in self.network.present.values() if matches(key, token)}
        for token in sorted(there):
            on_change(token, True)
        return handle

    def close(self) -> None:
        for handle in list(self._handles):
            handle.close()
        self._handles.clear()

    def _add(self, table: dict[object, T], row: T) -> Handle:
        token = object()
        with self.network.lock:
            table[token] = row

        def remove() -> None:
            table.pop(token, None)

        return self._keep(Handle(remove))

    def _keep(self, handle: Handle) -> Handle:
        self._handles.add(handle)
        return handle
