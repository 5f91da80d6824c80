"""A router in this process: it moves packets between those who dial in, by name, and can read none of them.

Several routers form a mesh: each names others to connect to. Zenoh cannot change access control while it runs, so when the
policy or the deny list changes the router starts again with the new rules; its clients find another router in a moment, or
this one again within a second, and what they missed is replayed.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from tutelage.errors import ConfigError, TutelageError
from tutelage.sgc import lanes
from tutelage.sgc.access import Role
from tutelage.sgc.acl import access_control
from tutelage.sgc.diagnosis import answer
from tutelage.sgc.home import Home
from tutelage.sgc.ports import free_port
from tutelage.sgc.reasons import Refusals, Refused
from tutelage.sgc.renewal import Renewer
from tutelage.sgc.roll import EVERYBODY, WAITING, Roll
from tutelage.sgc.transport.base import NoReply
from tutelage.sgc.transport.config import Endpoint, Identity, Timers, import_zenoh, zenoh_config, zenoh_settings
from tutelage.sgc.transport.tunnel import TunnelServer

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

FOLLOW = 1.0
"""Seconds between two looks at the router's folder."""


@dataclass(frozen=True)
class RouterConfig:
    """Where a router listens and which others it joins.

    Attributes:
        listen: addresses, such as tls/0.0.0.0:7447.
        mesh: addresses of other routers.
    """

    listen: tuple[Endpoint, ...]
    mesh: tuple[Endpoint, ...] = ()
    timers: Timers = field(default_factory=Timers)

    @classmethod
    def of(cls, listen: Sequence[str], mesh: Sequence[str] = (), timers: Timers | None = None) -> RouterConfig:
        """From addresses as text.

        Raises:
            ConfigError: no address, or an impossible one.
        """
        if not listen:
            raise ConfigError("a router must listen somewhere, such as tls/0.0.0.0:7447")
        return cls(tuple(map(Endpoint.parse, listen)), tuple(map(Endpoint.parse, mesh)), timers or Timers())


class Router:
    """Runs from `start` to `close`."""

    def __init__(self, home: Home, config: RouterConfig) -> None:
        """
        Raises:
            ConfigError: the home is not a router's.
            NotIssued: it has no valid certificate.
        """
        if home.role != Role.ROUTER:
            raise ConfigError(f"{home.name} is a node; a router needs a home of its own: tutelage keys init --router")
        home.check()
        self.home = home
        self.config = config
        self.starts = 0
        self.refusals = Refusals()
        self._zenoh = import_zenoh()
        self._session: zenoh.Session | None = None
        self._roll: Roll | None = None
        self._identity = Identity(home.root_file, home.leaf_file, home.key_file)
        self._listen = [each for each in config.listen if each.protocol in ("tls", "quic")]
        if len(self._listen) < len(config.listen):
            self._listen.append(Endpoint("tls", "127.0.0.1", free_port()))  # where tunnels end
        self._tunnels: list[TunnelServer] = []
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="sgc-router", daemon=True)
        self._renewer = Renewer(home, self._ask)

    def start(self) -> None:
        """Listen.

        Raises:
            ConfigError: an address is in use or not this machine's.
        """
        self._begin()
        self._thread.start()
        self._renewer.start()

    def close(self) -> None:
        """Stop."""
        self._closed.set()
        self._renewer.close()
        if self._thread.is_alive():
            self._thread.join(5.0)
        self._end()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def running(self) -> bool:
        """Does it listen?"""
        return self._session is not None

    @property
    def links(self) -> list[tuple[str, bool]]:
        """Who is connected: pseudonym or address, and whether it is a router."""
        session = self._session
        if session is None:
            return []
        routers = set(map(str, session.info.routers_zid()))
        return [(link.auth_identifier or link.dst, str(link.zid) in routers) for link in session.info.links()]

    def rules(self) -> dict[str, Any]:
        """The access control that the home's policy and deny list call for now."""
        access, denied = self.home.access, self.home.trust.deny_list.pseudonyms
        office = access.renewals.pseudonym if access.renewals else ""
        return access_control(access.routes, access.members, access.routers, access.control, denied, office)

    def _settings(self) -> dict[str, Any]:
        settings = zenoh_settings("router", self.config.timers, self._identity)
        settings["listen"] = {"endpoints": [str(each) for each in self._listen], "exit_on_failure": True}
        settings["connect"] |= {
            "endpoints": [str(each) for each in self.config.mesh],
            "timeout_ms": -1,
            "exit_on_failure": False,
        }
        settings["access_control"] = self._rules
        return settings

    def _begin(self) -> None:
        self._rules, self._routes = self.rules(), self.home.access.routes
        try:
            session: zenoh.Session = self._zenoh.open(zenoh_config(self._settings()))
        except self._zenoh.ZError as error:
            where = ", ".join(map(str, self.config.listen))
            raise ConfigError(f"{self.home.name} cannot listen on {where}: {str(error).split(' at /')[0]}") from None
        self._session = session
        inner = self._listen[-1].port
        try:
            for each in self.config.listen:
                if each.protocol in ("ws", "wss"):
                    self._tunnels.append(TunnelServer(each, inner, self._identity))
        except BaseException:
            self._end()  # all of it or nothing: what is left would be in the way of the next attempt
            raise
        self.starts += 1
        deny = lanes.key(self.home.access.control, lanes.DENY)
        session.declare_subscriber(deny, self._zenoh.handlers.Callback(self._on_deny, indirect=True))
        rules = lanes.key(self.home.access.control, lanes.RULES)
        session.declare_queryable(rules, self._zenoh.handlers.Callback(self._on_rules, indirect=True))
        self._keep_roll(session)

    def _keep_roll(self, session: zenoh.Session) -> None:
        """Follow who is present, and answer for it."""
        channel, put = self._zenoh.handlers.FifoChannel, self._zenoh.SampleKind.PUT
        parts = [session.liveliness().declare_subscriber(part, channel(WAITING), history=True) for part in EVERYBODY]

        def changes() -> Iterator[tuple[str, bool]]:
            for part in parts:
                while (sample := part.try_recv()) is not None:
                    yield str(sample.key_expr), sample.kind == put

        self._roll = Roll(changes)
        asked = self._zenoh.handlers.Callback(self._roll.asked, indirect=False)
        for part in EVERYBODY:
            session.declare_queryable(part, asked, complete=True)  # complete: in a mesh, the nearest router answers

    def _end(self) -> None:
        for tunnel in self._tunnels:
            tunnel.close()
        self._tunnels.clear()
        roll, self._roll = self._roll, None
        if roll is not None:
            roll.close()
        session, self._session = self._session, None
        if session is not None:
            session.close()

    def _on_deny(self, sample: zenoh.Sample) -> None:
        notice = sample.payload.to_bytes()
        if notice == self.home.deny_notice:
            return
        try:
            self.home.accept(notice)
        except Refused as refused:
            self.refusals.add(refused.reason)
        except TutelageError as error:
            log.warning("%s: %s", self.home.name, error)

    def _on_rules(self, query: zenoh.Query) -> None:
        """A node asks which of its topics we know."""
        try:
            known = answer(query.payload.to_bytes() if query.payload is not None else b"", self._routes)
            if known is not None:
                query.reply(query.key_expr, known)
        except self._zenoh.ZError as error:
            log.debug("%s: %s", self.home.name, error)
        finally:
            query.drop()

    def _ask(self, key: str, payload: bytes, timeout: float) -> bytes:
        session = self._session
        for reply in session.get(key, payload=payload, timeout=timeout) if session is not None else ():
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
        raise NoReply(f"nobody renews the certificate of {self.home.name} now")

    def _follow(self) -> None:
        """Start again when the folder calls for other rules, or holds a new certificate."""
        expires = self.home.expires
        while not self._closed.wait(FOLLOW):
            try:
                self.home.refresh()
            except TutelageError as error:
                log.warning("%s", error)
            try:
                if self.running and self.home.expires == expires and self.rules() == self._rules:
                    continue
                log.info("%s starts again with other rules or a new certificate", self.home.name)
                expires = self.home.expires
                self._end()
                self._insist(self._begin)
            except TutelageError as error:
                log.error("%s: %s", self.home.name, error)

    def _insist(self, begin: Callable[[], None]) -> None:
        """The port may take a moment to become free."""
        until = time.monotonic() + 10.0
        while True:
            try:
                begin()
                return
            except ConfigError:
                if time.monotonic() > until or self._closed.wait(0.1):
                    raise
