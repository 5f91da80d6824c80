"""A rosbridge (protocol 2.0, over WebSocket) on the fleet's topics: for roslibpy, roslibjs and web pages, without ROS.

On loopback by default; elsewhere it wants a token. Browsers tell which page a script came from (Origin): pages of this
machine are let in, others only if listed, as any page in the world could otherwise use a browser here to reach the bridge.
"""

from __future__ import annotations

import asyncio
import http
import logging
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from tutelage.errors import ConfigError, MissingExtraError
from tutelage.sgc.proxies.counts import Counts
from tutelage.sgc.proxies.listen import Tls, check_listen, has_token, is_loopback
from tutelage.sgc.proxies.ros_types import RosTypes
from tutelage.sgc.proxies.rosbridge_outbox import TooSlow
from tutelage.sgc.proxies.rosbridge_services import Service
from tutelage.sgc.proxies.rosbridge_session import Session
from tutelage.sgc.proxies.rosbridge_topics import Codecs, Topic
from tutelage.sgc.proxies.routes import Routes

if TYPE_CHECKING:
    from tutelage.sgc.node import Node

log = logging.getLogger(__name__)
MAX_MESSAGE = 32 << 20
"""Bytes of one message from a client."""
MAX_CLIENTS = 256
_POLITELY = 2.0  # seconds for clients to say goodbye when the bridge closes
_CALLS = 64  # service calls of all clients that may block at a time


class Bridge:
    """Serves clients until it is closed; on a thread and an event loop of its own.

    Args:
        node: on the fleet's network. Not closed by `close`.
        routes: what clients may use.
        types: definitions of the types.
        host, port: where to listen; port 0: any. `address` tells.
        token: what clients must bring, as `Authorization: Bearer ...` or `?token=...`.
        origins: pages, such as "https://operators.example", whose scripts may connect; "null" for files.
        tls: for wss://; needed off loopback.

    Raises:
        MissingExtraError: websockets or rosbags is not installed.
        ConfigError: not on loopback and without protection, two routes with one name, or the port cannot be had.
    """

    def __init__(
        self,
        node: Node,
        routes: Routes,
        types: RosTypes,
        *,
        host: str = "127.0.0.1",
        port: int = 9090,
        token: str | None = None,
        origins: Sequence[str] = (),
        tls: Tls | None = None,
        max_message: int = MAX_MESSAGE,
    ) -> None:
        check_listen("a rosbridge", host, token, tls)
        self.routes, self.max_message = routes, max_message
        self.counts = Counts("clients", "turned_away", "messages", "refused", "too_slow", "dropped")
        self.loop = asyncio.new_event_loop()
        self._pool = ThreadPoolExecutor(_CALLS, thread_name_prefix="rosbridge-call")
        codecs = Codecs(types)
        self.topics = {route.name: Topic(node, route, codecs, self.loop) for route in routes.topics}
        self.services = {route.name: Service(node, route, codecs, self._pool) for route in routes.services}
        if len(self.topics) < len(routes.topics) or len(self.services) < len(routes.services):
            raise ConfigError("two routes have the same name; a rosbridge has only one of each")
        self._token, self._origins = token, set(origins)
        self._connections: set[Any] = set()
        self._server: Any = None
        self._thread = threading.Thread(target=self.loop.run_forever, name="rosbridge", daemon=True)
        self._thread.start()
        try:
            asyncio.run_coroutine_threadsafe(self._start(host, port, tls), self.loop).result()
        except BaseException:
            self._end_loop()
            raise

    @property
    def address(self) -> tuple[str, int]:
        """Where it listens."""
        host, port = self._server.sockets[0].getsockname()[:2]
        return host, port

    def counters(self) -> dict[str, Any]:
        """What was counted: for the bridge, and topics/<alias>/..."""
        topics = {t.route.alias: t.counts.as_dict(dropped=t.dropped) for t in self.topics.values()}
        services = {s.route.alias: s.counts.as_dict() for s in self.services.values()}
        return {**self.counts.as_dict(connected=len(self._connections)), "topics": {**topics, **services}}

    def close(self) -> None:
        """Disconnect everybody and stop."""
        if self._thread.is_alive():
            asyncio.run_coroutine_threadsafe(self._stop(), self.loop).result(10.0)
            self._end_loop()

    def __enter__(self) -> Bridge:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    async def _start(self, host: str, port: int, tls: Tls | None) -> None:
        try:
            from websockets.asyncio.server import serve
        except ImportError:
            raise MissingExtraError("websockets", "rosbridge") from None
        try:
            self._server = await serve(
                self._serve,
                host,
                port,
                process_request=self._admit,
                max_size=self.max_message,
                max_queue=4,
                close_timeout=1,
                compression=None,
                ssl=tls.context() if tls is not None else None,
                logger=logging.getLogger(f"{__name__}.websockets"),
            )
        except OSError as error:
            raise ConfigError(f"cannot listen on {host}:{port}: {error.strerror}") from None
        for topic in self.topics.values():
            topic.start()

    def _admit(self, connection: Any, request: Any) -> Any:
        """None: come in; otherwise the refusal."""
        if len(self._connections) >= MAX_CLIENTS:
            return self._refuse(connection, http.HTTPStatus.SERVICE_UNAVAILABLE, "too many clients")
        origins = request.headers.get_all("Origin")
        if any(not self._known_origin(origin) for origin in origins):
            return self._refuse(connection, http.HTTPStatus.FORBIDDEN, f"origin {origins[0][:100]!r} is not listed")
        if self._token is not None and not self._has_token(request):
            return self._refuse(connection, http.HTTPStatus.UNAUTHORIZED, "the token is missing or wrong")
        return None

    def _refuse(self, connection: Any, status: http.HTTPStatus, why: str) -> Any:
        self.counts.add("turned_away")
        log.warning("rosbridge turned a client away: %s", why)
        return connection.respond(status, f"{why}\n")

    def _known_origin(self, origin: str) -> bool:
        if origin in self._origins:
            return True
        try:
            host = urlsplit(origin).hostname
        except ValueError:
            return False
        return host is not None and is_loopback(host)

    def _has_token(self, request: Any) -> bool:
        given = request.headers.get_all("Authorization") + parse_qs(urlsplit(request.path).query).get("token", [])
        return has_token(given, self._token or "")

    async def _serve(self, connection: Any) -> None:
        from websockets.exceptions import ConnectionClosed

        self._connections.add(connection)
        self.counts.add("clients")
        session = Session(self)
        writer = self.loop.create_task(self._write(connection, session))
        try:
            async for frame in connection:
                self.counts.add("messages")
                await session.handle(frame)
                await session.outbox.room()
        except TooSlow:
            self.counts.add("too_slow")
            connection.transport.abort()  # to close politely, the other side would have to read
        except ConnectionClosed:
            pass
        finally:
            self._connections.discard(connection)
            writer.cancel()
            await session.close()
            self.counts.add("dropped", session.outbox.dropped)

    async def _write(self, connection: Any, session: Session) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            while True:
                for frame in await session.outbox.get():
                    await connection.send(frame)
        except ConnectionClosed:
            return

    async def _stop(self) -> None:
        self._server.close()
        try:
            await asyncio.wait_for(asyncio.shield(self._server.wait_closed()), _POLITELY)
        except TimeoutError:
            for connection in self._connections:
                connection.transport.abort()
            await self._server.wait_closed()
        for topic in self.topics.values():
            await topic.close()

    def _end_loop(self) -> None:
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join(5.0)
        self._pool.shutdown(wait=False, cancel_futures=True)
        if not self._thread.is_alive():
            self.loop.close()
