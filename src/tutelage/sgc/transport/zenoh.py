"""Over Zenoh: a client of the routers that `network.toml` names. It dials out, so it works behind NAT and firewalls.

Opening never waits for a router: what is declared before there is one, and whatever was declared when a connection is lost,
is declared again as soon as a router answers. `renew` opens a second connection with the new certificate, declares
everything on it and only then closes the first, so nothing is lost between them.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tutelage.errors import ConfigError
from tutelage.sgc.transport.base import Handle, NoReply, Transport, check_key
from tutelage.sgc.transport.config import Endpoint, Identity, NetworkConfig, import_zenoh, zenoh_config, zenoh_settings
from tutelage.sgc.transport.watch import Watch
from tutelage.sgc.workers import Workers

if TYPE_CHECKING:
    import zenoh

    from tutelage.sgc.transport.tunnel import TunnelClient

log = logging.getLogger(__name__)

OVERLAP = 0.5
"""Seconds for which `renew` keeps the old connection beside the new one, until the routers know the new one."""

SERVING, SLOW = 8, 32
"""Requests that are answered at a time: on all keys together, and on each key whose answers are slow."""

WAITING = 64
"""Requests that may wait for that; further ones are turned away at once."""

WATCHES = 1 << 16
"""Watches that may wait to be declared in another way."""


class _Declaration:
    """Something declared on a session, and how to declare it on the next one."""

    def __init__(self, declare: Callable[[zenoh.Session], Any]) -> None:
        self.declare = declare
        self.on: Any = None

    def move(self, session: zenoh.Session) -> None:
        """Declare it on a session; the one on an earlier session ends with that session."""
        self.on = self.declare(session)

    def end(self) -> None:
        """Undeclare it, if its session still lives."""
        if self.on is not None:
            with contextlib.suppress(Exception):  # the session may be gone, and Zenoh has one type for all errors
                self.on.undeclare()


class ZenohTransport(Transport):
    """A connection to one router out of several."""

    def __init__(self, network: NetworkConfig, identity: Identity | None) -> None:
        """Try to connect once; if that fails, go on trying in the background.

        identity: None: no encryption on the way to the router, for tests and benchmarks ("tcp/..." endpoints).

        Raises:
            MissingExtraError: Zenoh is not installed.
            ConfigError: the certificate or key cannot be used.
        """
        self._zenoh = import_zenoh()
        self.network = network
        self.identity = identity
        self._lock = threading.RLock()
        self._declarations: set[_Declaration] = set()
        self._publishers: dict[tuple[str, bool], zenoh.Publisher] = {}
        self._session: zenoh.Session | None = None
        self._closed = threading.Event()
        self._tunnels: dict[Endpoint, TunnelClient] = {}
        self._pool = Workers("sgc-serve", SERVING, WAITING)
        self._watching = Workers("sgc-watch", 1, WATCHES)
        self._sessions = 0
        self._check_identity()
        if not self._connect():
            threading.Thread(target=self._keep_connecting, name="sgc-connect", daemon=True).start()

    @property
    def connected(self) -> bool:
        session = self._session
        return session is not None and not session.is_closed() and bool(session.info.routers_zid())

    def publish(self, key: str, payload: bytes | bytearray, *, reliable: bool = True) -> None:
        publisher = self._publishers.get((key, reliable)) or self._publisher(key, reliable)
        if publisher is not None:
            try:  # not `contextlib.suppress`, which costs a twentieth of what a small message does
                publisher.put(payload)
            except self._zenoh.ZError:
                return  # closed between the two lines: lost, as without connection

    def subscribe(self, key: str, on_packet: Callable[[bytes], None]) -> Handle:
        check_key(key, wildcard=True)

        def arrived(sample: zenoh.Sample) -> None:
            on_packet(sample.payload.to_bytes())

        return self._declare(lambda session: session.declare_subscriber(key, self._direct(arrived)))

    def serve(self, key: str, on_request: Callable[[bytes], bytes | None], *, slow: bool = False) -> Handle:
        check_key(key)
        pool = Workers("sgc-serve", SLOW, WAITING) if slow else self._pool

        def answer(query: zenoh.Query) -> None:
            try:
                reply = on_request(query.payload.to_bytes() if query.payload is not None else b"")
                if reply is not None:
                    query.reply(key, reply)
            except Exception:
                log.exception("a request could not be answered")
            finally:
                query.drop()

        def asked(query: zenoh.Query) -> None:
            if not pool.submit(answer, query):
                query.drop()

        handle = self._declare(lambda session: session.declare_queryable(key, self._direct(asked)))
        if not slow:
            return handle

        def stop() -> None:
            handle.close()
            pool.close()

        return Handle(stop)

    def request(self, key: str, payload: bytes | bytearray, timeout: float) -> bytes:
        check_key(key)
        session = self._session
        if session is not None:
            consolidation = self._zenoh.ConsolidationMode.NONE
            with contextlib.suppress(self._zenoh.ZError):  # the session closed meanwhile: nobody answers
                for reply in session.get(key, payload=payload, timeout=timeout, consolidation=consolidation):
                    if reply.ok is not None:
                        return reply.ok.payload.to_bytes()
        raise NoReply(f"nobody answered within {timeout:g} s")

    def announce(self, key: str) -> Handle:
        check_key(key)
        return self._declare(lambda session: session.liveliness().declare_token(key))

    def watch(self, key: str, on_change: Callable[[str, bool], None]) -> Handle:
        check_key(key, wildcard=True)

        return self._declare(lambda session: Watch(self._zenoh, session, key, on_change, self._watching.submit))

    def renew(self) -> None:
        self._check_identity()
        with self._lock:
            before = self._session
            if before is None or self._closed.is_set():
                return  # the next attempt to connect reads the new files anyway
        fresh = self._open()
        if fresh is None:
            log.warning("no router accepts the new certificate yet; the old connection stays")
            return
        self._adopt(fresh)
        retire = threading.Timer(OVERLAP, before.close)
        retire.daemon = True
        retire.start()

    def close(self) -> None:
        self._closed.set()
        with self._lock:
            session, self._session = self._session, None
            self._declarations.clear()
            self._publishers.clear()
        if session is not None:
            session.close()
        for tunnel in self._tunnels.values():
            tunnel.close()
        for pool in (self._pool, self._watching):
            pool.close()
            pool.join(1.0)

    # -- connecting ---------------------------------------------------------------------------------------------------------

    def _check_identity(self) -> None:
        for path in vars(self.identity).values() if self.identity else ():
            if not path.is_file():
                raise ConfigError(f"{path} is missing; has this node been issued a certificate? (tutelage keys issue)")

    def _open(self) -> zenoh.Session | None:
        """A session with the first router that answers; None: none does."""
        settings = zenoh_settings("client", self.network.timers, self.identity)
        settings["connect"] |= {"endpoints": [self._locator(each) for each in self.network.routers], "timeout_ms": 0}
        settings["connect"]["exit_on_failure"] = True
        try:
            return self._zenoh.open(zenoh_config(settings))  # type: ignore[no-any-return]
        except self._zenoh.ZError as error:
            log.info("no router answers: %s", str(error).split(" at /")[0])
            return None

    def _locator(self, router: Endpoint) -> str:
        """Where Zenoh connects to in order to reach a router."""
        if router.protocol not in ("ws", "wss"):
            return str(router)
        from tutelage.sgc.transport.tunnel import TunnelClient  # loads asyncio, which others need not wait for

        if self.identity is None:
            raise ConfigError(f"{router} needs certificates: TLS runs inside the WebSocket")
        with self._lock:
            if router not in self._tunnels:
                self._tunnels[router] = TunnelClient(router, self.identity)
            return self._tunnels[router].endpoint

    def _connect(self) -> bool:
        session = self._open()
        if session is not None:
            self._adopt(session)
        return session is not None

    def _keep_connecting(self) -> None:
        pause = self.network.timers.retry_first
        while not self._closed.wait(pause) and not self._connect():
            pause = min(2 * pause, self.network.timers.retry_last)

    def _adopt(self, session: zenoh.Session) -> None:
        """Everything happens on this session from now on."""
        with self._lock:
            if self._closed.is_set():
                session.close()
                return
            self._sessions += 1
            self._follow(session, self._sessions)
            for declaration in self._declarations:
                declaration.move(session)
            self._session = session
            self._publishers = {}

    def _follow(self, session: zenoh.Session, number: int) -> None:
        """Tell the watches when this session loses its router; it looks for another by itself. number: of the session."""

        def changed(event: zenoh.TransportEvent) -> None:
            if event.kind == self._zenoh.SampleKind.DELETE:
                self._watching.submit(self._cut_off, number)

        session.info.declare_transport_events_listener(self._direct(changed))

    def _cut_off(self, number: int) -> None:
        with self._lock:
            if number != self._sessions or self._session is None:
                return  # it was closed, as another has taken its place
            watches = [each.on for each in self._declarations if isinstance(each.on, Watch)]
        for watch in watches:
            watch.cut_off()

    def _publisher(self, key: str, reliable: bool) -> zenoh.Publisher | None:
        check_key(key)
        with self._lock:
            if self._session is None:
                return None
            control = self._zenoh.CongestionControl
            publisher = self._session.declare_publisher(key, congestion_control=control.BLOCK if reliable else control.DROP)
            self._publishers[key, reliable] = publisher
            return publisher

    def _direct(self, call: Callable[[Any], None]) -> Any:
        """A handler that runs on the network's own thread. Zenoh's default would put an unbounded queue in between."""
        return self._zenoh.handlers.Callback(call, indirect=False)

    def _declare(self, declare: Callable[[zenoh.Session], Any]) -> Handle:
        declaration = _Declaration(declare)
        with self._lock:
            self._declarations.add(declaration)
            if self._session is not None:
                declaration.move(self._session)

        def stop() -> None:
            with self._lock:
                self._declarations.discard(declaration)
                declaration.end()

        return Handle(stop)
