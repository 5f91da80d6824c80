"""Through firewalls that let only web traffic pass: the node's TLS connection to its router, carried inside a WebSocket.

Zenoh's own WebSocket link has no TLS, so a router could not know who dials in. Here the node speaks TLS to the router as
always, with certificates on both sides; the WebSocket around it is only a pipe. With wss the pipe is encrypted once more, as
networks demand that let only HTTPS pass; whoever ends it, such as a reverse proxy, sees TLS inside.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import ssl
import threading
from collections.abc import Coroutine
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from tutelage.errors import ConfigError, MissingExtraError
from tutelage.sgc.transport.config import Endpoint, Identity

log = logging.getLogger(__name__)

PATH = "/tutelage"
CHUNK = 64 << 10
CONNECTIONS = 1000
"""Of a router's tunnel at a time."""


class _Loop:
    """An event loop in a thread of its own."""

    def __init__(self, name: str) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever, name=name, daemon=True)
        self._thread.start()

    def run(self, work: Coroutine[Any, Any, Any]) -> Any:
        """Run on the loop and wait."""
        future: Future[Any] = asyncio.run_coroutine_threadsafe(work, self.loop)
        return future.result(10.0)

    def close(self) -> None:
        """End all that runs on it."""

        async def cancel() -> None:
            others = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
            for task in others:
                task.cancel()
            await asyncio.gather(*others, return_exceptions=True)

        if self._thread.is_alive():
            with contextlib.suppress(Exception):
                self.run(cancel())
            self.loop.call_soon_threadsafe(self.loop.stop)
            self._thread.join(5.0)
            self.loop.close()


class TunnelClient:
    """Listens on a free port of loopback; each connection to it goes to the router through a WebSocket."""

    def __init__(self, router: Endpoint, identity: Identity) -> None:
        """
        Args:
            router: a ws or wss address.

        Raises:
            MissingExtraError: the package websockets is not installed.
        """
        self._connect = _websockets("client").connect
        self._router = router
        self._ssl = _client_context(identity) if router.protocol == "wss" else None
        self._loop = _Loop("sgc-tunnel")

        async def listen() -> asyncio.Server:
            return await asyncio.start_server(self._carry, "127.0.0.1", 0)

        self._server: asyncio.Server = self._loop.run(listen())

    @property
    def endpoint(self) -> str:
        """Where Zenoh connects to. Certificates name routers by their own addresses, not by this one; any router of the
        fleet will do."""
        port = self._server.sockets[0].getsockname()[1]
        return f"tls/127.0.0.1:{port}#verify_name_on_connect=false"

    def close(self) -> None:
        """End all connections."""
        self._loop.close()

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        scheme, host, port = self._router.protocol, self._router.host, self._router.port
        proxy = None if _is_loopback(host) else True  # as the system's settings say
        try:
            async with self._connect(
                f"{scheme}://{host}:{port}{PATH}", ssl=self._ssl, compression=None, max_size=2 * CHUNK, proxy=proxy
            ) as socket:
                await _pipe(socket, reader, writer)
        except Exception as error:
            log.info("no tunnel to %s: %s", self._router, error)
        finally:
            writer.close()


class TunnelServer:
    """Accepts WebSockets and connects each to the router's TLS port on this machine."""

    def __init__(self, listen: Endpoint, tls_port: int, identity: Identity) -> None:
        """
        Args:
            listen: a ws or wss address.
            tls_port: where the router listens on loopback.

        Raises:
            MissingExtraError: the package websockets is not installed.
            ConfigError: the address is in use or not this machine's.
        """
        self._serve = _websockets("server").serve
        self._tls_port = tls_port
        context = None
        if listen.protocol == "wss":
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(identity.certificate, identity.key)
        self._loop = _Loop("sgc-tunnels")
        self._open = 0

        async def start() -> Any:
            host = listen.host.strip("[]")
            return await self._serve(
                self._carry, host, listen.port, ssl=context, compression=None, max_size=2 * CHUNK, close_timeout=1.0
            )

        try:
            self._server = self._loop.run(start())
        except OSError as error:
            self._loop.close()
            raise ConfigError(f"cannot listen on {listen}: {error.strerror or error}") from None

    def close(self) -> None:
        """End all connections."""

        async def stop() -> None:
            self._server.close()
            await self._server.wait_closed()

        with contextlib.suppress(Exception):
            self._loop.run(stop())
        self._loop.close()

    async def _carry(self, socket: Any) -> None:
        if socket.request.path != PATH or self._open >= CONNECTIONS:
            await socket.close(1008)
            return
        self._open += 1
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", self._tls_port)
            try:
                await _pipe(socket, reader, writer)
            finally:
                writer.close()
        except OSError as error:
            log.info("a tunnel ended: %s", error)
        finally:
            self._open -= 1


async def _pipe(socket: Any, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Bytes both ways, until either side ends."""

    async def outward() -> None:
        while data := await reader.read(CHUNK):
            await socket.send(data)

    async def inward() -> None:
        async for data in socket:
            if not isinstance(data, bytes):
                return  # text: not one of ours
            writer.write(data)
            await writer.drain()

    ways = [asyncio.create_task(outward()), asyncio.create_task(inward())]
    try:
        done, _ = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        for way in done:
            way.exception()  # looked at, so that asyncio does not complain; either way the tunnel ends
    finally:
        for way in ways:
            way.cancel()
        await asyncio.gather(*ways, return_exceptions=True)


def _client_context(identity: Identity) -> ssl.SSLContext:
    """The outer TLS of wss ends at one of our routers or at a web server with a public certificate."""
    context = ssl.create_default_context()
    context.load_verify_locations(Path(identity.root))
    return context


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def _websockets(side: str) -> Any:
    try:
        import websockets.asyncio.client
        import websockets.asyncio.server
    except ImportError:
        raise MissingExtraError("websockets", "sgc") from None
    return getattr(websockets.asyncio, side)
