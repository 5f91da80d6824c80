"""A node on the network: publish, subscribe, request and serve by alias, sealed end to end.

    with Node.open(Path("drone-1")) as node:
        camera = node.publisher("camera")
        camera.send(jpeg)

One thread looks after what a node owes to others and to itself: keys of topics that it wants or hands out, the deny list, a
certificate that was renewed on disk.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tutelage.errors import TutelageError
from tutelage.sgc import health, lanes
from tutelage.sgc.access import Access, Entry, Kind, Lane
from tutelage.sgc.diagnosis import Diagnosis
from tutelage.sgc.errors import NotAllowed
from tutelage.sgc.home import Home
from tutelage.sgc.key_exchange import KeyExchange
from tutelage.sgc.keyring import Keyring
from tutelage.sgc.messages import Message
from tutelage.sgc.presence import Peer, Presence
from tutelage.sgc.publisher import Publisher
from tutelage.sgc.reasons import Refusals, Refused
from tutelage.sgc.renewal import Renewer
from tutelage.sgc.sealing import Opener, Sealer
from tutelage.sgc.service import Requester, Server
from tutelage.sgc.subscription import Subscription
from tutelage.sgc.transport.base import Handle, Transport
from tutelage.sgc.workers import Workers

log = logging.getLogger(__name__)

TEND = 0.5
"""Seconds between two looks at keys and files."""


LAST_WORDS = 1.0
"""Seconds for which `close` waits for questions that are under way."""

GOSSIP = 10.0
"""Seconds after which the deny list is passed on again."""


class Node:
    """One per program. Everything it starts ends with `close`."""

    def __init__(self, home: Home, transport: Transport, *, own_transport: bool = False) -> None:
        """See `open`."""
        home.check()
        self.home = home
        self.transport = transport
        self.keyring = Keyring(home)
        self.refusals = Refusals()
        """Of grants, keys and notices; topics count their own."""
        self._own_transport = own_transport
        self._lock = threading.RLock()
        self._publishers: dict[str, Publisher] = {}
        self._subscriptions: list[Subscription] = []
        self._requesters: dict[str, Requester] = {}
        self._servers: dict[str, Server] = {}
        self._handles: list[Handle] = []
        self._pool = Workers("sgc-ask")
        self._wake = threading.Event()
        self._closed = threading.Event()
        self._certificate, self._version = home.expires, home.version
        self._gossiped = float("-inf")
        self._joined: dict[str, tuple[Entry, list[Handle]]] = {}
        self._keys = KeyExchange(self.keyring, transport, self._pool, self.refusals, self._wake.set, self._key_came)
        self.presence = Presence(self.keyring, home.pseudonym, transport, self._wake.set, self._pool)
        self.diagnosis = Diagnosis(home, transport, self._pool, self.lacking)
        self._deny_key = lanes.key(self.access.control, lanes.DENY)
        self._handles.append(transport.subscribe(self._deny_key, self._on_deny))
        self._follow_policy()
        self._thread = threading.Thread(target=self._tend, name="sgc-tend", daemon=True)
        self._thread.start()
        self._renewer = Renewer(home, transport.request)
        self._renewer.start()

    @classmethod
    def open(cls, home: Path | Home, transport: Transport | None = None) -> Node:
        """Come up, with or without a network: topics work as soon as a router and the topic's key are there.

        home: the node's folder (`tutelage keys`).
        transport: None: Zenoh, as the folder's `network.toml` says. A transport that is given is not closed by `close`.

        Raises:
            KeysError, NotIssued, ConfigError: the folder, certificate or `network.toml` cannot be used.
            MissingExtraError: a package of the extra sgc is missing.
        """
        if not isinstance(home, Home):
            home = Home.open(home)
        home.check()
        if transport is not None:
            return cls(home, transport)
        from tutelage.sgc.transport.config import Identity, NetworkConfig
        from tutelage.sgc.transport.zenoh import ZenohTransport

        network = NetworkConfig.load(home.path)
        made = ZenohTransport(network, Identity(home.root_file, home.leaf_file, home.key_file))
        try:
            return cls(home, made, own_transport=True)
        except BaseException:
            made.close()
            raise

    @property
    def name(self) -> str:
        """Of this node."""
        return self.home.name

    @property
    def access(self) -> Access:
        """What this node may do: `access.topics` by alias."""
        return self.home.access

    @property
    def connected(self) -> bool:
        """Is there a connection to a router?"""
        return self.transport.connected

    def lacking(self) -> list[str]:
        """Aliases of topics whose keys have not come yet."""
        return [alias for alias in self.keyring.wanted() if self.keyring.epoch(alias) is None]

    def publisher(self, alias: str) -> Publisher:
        """The publisher of a topic; the same one each time, until it is closed.

        Raises:
            NotAllowed: the policy does not let this node publish there.
        """
        entry = self._entry(alias, Kind.STREAM)
        with self._lock:
            publisher = self._publishers.get(alias)
            if publisher is None or publisher.closed:
                sealer = Sealer(self.keyring, alias)
                publisher = self._publishers[alias] = Publisher(alias, entry, sealer, self.transport, self._wake.set)
            return publisher

    def subscribe(
        self,
        alias: str,
        on_message: Callable[[Message], None] | None = None,
        *,
        queue: int | None = None,
        provisional: bool = False,
        direct: bool = False,
    ) -> Subscription:
        """Receive a topic's messages.

        on_message: called on a thread of the subscription's own; may take its time. An exception is logged and counted.
        queue: messages that may wait for the application; default: 64 on a reliable topic, 1 on a lossy one. Beyond: on a
            reliable topic, the rest is fetched again from the publisher when there is room; on a lossy one the newest win.
        provisional: chain mode: deliver at once, with `Message.authentic` False, what the chain confirms 20 ms later.
        direct: call `on_message` on the network's own thread, which saves a change of threads; it must return at once, as
            everything else that this node receives waits for it. For control loops.

        Raises:
            NotAllowed: the policy does not let this node subscribe there.
        """
        entry = self._entry(alias, Kind.STREAM)
        opener = Opener(self.keyring, alias, provisional=provisional)
        subscription = Subscription(
            alias, entry, opener, self.transport, self._wake.set, self._pool, on_message, queue, direct
        )
        with self._lock:
            self._subscriptions = [each for each in self._subscriptions if not each.closed] + [subscription]
        return subscription

    def request(self, alias: str, payload: bytes, timeout: float = 2.0) -> bytes:
        """Ask a service. Blocks for at most `timeout` seconds.

        Raises:
            NotAllowed: the policy does not let this node request there.
            NoReply: nobody answered in time.
            RequestFailed: the handler raised; the message is its own.
        """
        entry = self._entry(alias, Kind.SERVICE)
        with self._lock:
            requester = self._requesters.get(alias)
            if requester is None:
                sealer, opener = Sealer(self.keyring, alias, Lane.REQUEST), Opener(self.keyring, alias, Lane.REPLY)
                key = lanes.key(entry.name, lanes.CALL)
                requester = Requester(alias, key, sealer, opener, self.transport, self._wake.set)
                self._requesters[alias] = requester
        return requester.request(payload, timeout).payload

    def serve(self, alias: str, handler: Callable[[Message], bytes]) -> Handle:
        """Answer a service's requests; each is handled once, on one of a few threads. An exception becomes RequestFailed.

        Raises:
            NotAllowed: the policy does not let this node serve there.
        """
        entry = self._entry(alias, Kind.SERVICE)
        sealer, opener = Sealer(self.keyring, alias, Lane.REPLY), Opener(self.keyring, alias, Lane.REQUEST)
        server = self._servers[alias] = Server(alias, sealer, opener, handler)
        handle = self.transport.serve(lanes.key(entry.name, lanes.CALL), server.answer, slow=True)
        self._handles.append(handle)
        return handle

    def peers(self, timeout: float = 1.0) -> list[Peer]:
        """Who else is present on the topics of this node, each verified by a ping when it is first met.

        timeout: seconds to wait for those met for the first time.
        """
        return self.presence.peers(timeout)

    def ping(self, name: str, timeout: float = 2.0) -> float:
        """The round trip to another node and back, sealed and signed both ways, in seconds.

        Raises:
            NoReply: no such node is present on a topic of ours, or it does not answer in time.
        """
        return self.presence.ping(name, timeout)

    def close(self) -> None:
        """Close publishers, subscriptions, services and, if `open` made it, the transport."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._wake.set()
        self._renewer.close()
        for publisher in self._publishers.values():
            publisher.close()
        for subscription in self._subscriptions:
            subscription.close()
        for handle in self._handles:
            handle.close()
        for _, joined in self._joined.values():
            for handle in joined:
                handle.close()
        self.presence.close()
        self._pool.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(2.0)
        if self._own_transport:
            self.transport.close()
        self._pool.join(LAST_WORDS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def publishers(self) -> dict[str, Publisher]:
        """Those that are open, by alias."""
        with self._lock:
            return {alias: each for alias, each in self._publishers.items() if not each.closed}

    def subscriptions(self) -> list[Subscription]:
        """Those that are open."""
        with self._lock:
            return [each for each in self._subscriptions if not each.closed]

    def requesters(self) -> dict[str, Requester]:
        """By alias."""
        with self._lock:
            return dict(self._requesters)

    def servers(self) -> dict[str, Server]:
        """By alias."""
        with self._lock:
            return dict(self._servers)

    def counters(self) -> dict[str, Any]:
        """Everything that is counted; see `health`."""
        return health.counters(self)

    def _entry(self, alias: str, kind: Kind) -> Entry:
        entry = self.access.entry(alias)
        if entry.rule.kind != kind:
            verbs = "publish and subscribe" if entry.rule.kind == Kind.STREAM else "request and serve"
            raise NotAllowed(f"{alias} is a {entry.rule.kind}: {self.name} can only {verbs} there")
        return entry

    # -- what a node owes to others and to itself --------------------------------------------------------------------------

    def _join(self, alias: str, entry: Entry) -> None:
        """Take part in a topic of the policy."""
        handles = [self._keys.join(alias, entry)]
        handles += self.presence.join(alias, entry)
        if not self.keyring.owns(alias):
            self.presence.directory.subscribe(entry.name, partial(self._keys.somebody_came, alias))
        self._joined[alias] = (entry, handles)

    def _follow_policy(self) -> None:
        """Topics may have come, gone, or changed their owner or name."""
        topics = self.access.topics
        for alias, (entry, handles) in list(self._joined.items()):
            if topics.get(alias) != entry:
                for handle in handles:
                    handle.close()
                self.presence.leave(alias)
                del self._joined[alias]
        for alias, entry in topics.items():
            if alias not in self._joined:
                self._join(alias, entry)

    def _key_came(self, alias: str) -> None:
        with self._lock:
            publisher = self._publishers.get(alias)
            waiting = [each for each in self._subscriptions if each.alias == alias]
        if publisher is not None:
            publisher.key_came()
        for subscription in waiting:
            subscription.retry()

    def _tend(self) -> None:
        turn = 0.0
        while not self._closed.is_set():
            self._wake.clear()
            try:
                pause = self._keys.fetch()
                if time.monotonic() >= turn:
                    turn = time.monotonic() + TEND
                    self._follow_files()
                    self._keys.hand_out()
                    self._gossip()
                    self.diagnosis.look()
            except TutelageError as error:
                log.warning("%s: %s", self.name, error)
                pause = TEND
            except Exception:
                log.exception("%s", self.name)
                pause = TEND
            self._wake.wait(max(0.01, min(pause, turn - time.monotonic())))

    def _follow_files(self) -> None:
        """Certificate, policy and deny list may have changed on disk."""
        self.home.refresh()
        if self.home.version == self._version:
            return
        self._version = self.home.version
        if self.home.expires != self._certificate:
            self._certificate = self.home.expires
            self.transport.renew()
            log.info("%s goes on with its new certificate", self.name)
        self._follow_policy()

    def _gossip(self) -> None:
        """Pass on the deny list, so that it reaches those who were away."""
        notice = self.home.deny_notice
        if notice is not None and time.monotonic() - self._gossiped >= GOSSIP:
            self._gossiped = time.monotonic()
            self.transport.publish(self._deny_key, notice)

    def _on_deny(self, notice: bytes) -> None:
        if notice != self.home.deny_notice and not self._closed.is_set():
            self._pool.submit(self._take_deny_list, notice)

    def _take_deny_list(self, notice: bytes) -> None:
        try:
            if self.home.accept(notice) == "deny":
                self._gossiped = float("-inf")
                self._wake.set()
        except Refused as refused:
            self.refusals.add(refused.reason)
        except TutelageError as error:
            log.warning("%s: %s", self.name, error)
