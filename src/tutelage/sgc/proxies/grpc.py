"""A gRPC gateway to the fleet's topics and services, for programs in any language; tutelage.proto says what it offers.

On loopback by default, or on a Unix socket. The nodes' own certificates (Ed25519) cannot be used for its TLS: gRPC's library
does not accept such keys. It takes certificates of your own, and clients prove themselves by certificate or token.
"""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING, Any

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from tutelage.errors import ConfigError, MissingExtraError
from tutelage.sgc.proxies.listen import Tls, check_listen, has_token, parse_address

if TYPE_CHECKING:
    from tutelage.sgc.node import Node
    from tutelage.sgc.proxies.grpc_calls import Calls

MAX_MESSAGE = 64 << 20
MAX_CALLS = 1000
"""Calls, streams included, that may be under way."""


class Gateway:
    """Serves clients until it is closed; on a thread and an event loop of its own.

    Args:
        node: on the fleet's network. Not closed by `close`.
        listen: "host:port", with port 0 for any, or "unix:path". `address` tells.
        token: what clients must bring in the metadata: authorization: Bearer ...
        tls: for TLS; needed off loopback.

    Raises:
        MissingExtraError: grpcio or protobuf is not installed.
        ConfigError: not on loopback and without protection, or the address cannot be had.
    """

    def __init__(
        self, node: Node, *, listen: str = "127.0.0.1:50051", token: str | None = None, tls: Tls | None = None
    ) -> None:
        try:
            import grpc.aio
        except ImportError:
            raise MissingExtraError("grpcio", "grpc") from None
        if listen == "unix:":
            raise ConfigError("'unix:' names no socket; write unix:PATH")
        if not listen.startswith("unix:"):
            check_listen("a gRPC gateway", parse_address(listen)[0], token, tls)
        if tls is not None:
            _check(tls)
        self._listen, self._token, self._tls = listen, token, tls
        self._server: grpc.aio.Server | None = None
        self._calls: Calls | None = None
        self.address = ""
        """Where it listens."""
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="grpc-gateway", daemon=True)
        self._thread.start()
        try:
            asyncio.run_coroutine_threadsafe(self._start(node), self._loop).result()
        except BaseException:
            self._end_loop()
            raise

    def counters(self) -> dict[str, Any]:
        """What was counted."""
        return dict(self._calls.counts.as_dict()) if self._calls is not None else {}

    def close(self) -> None:
        """End all calls and stop."""
        if self._thread.is_alive():
            asyncio.run_coroutine_threadsafe(self._stop(), self._loop).result(10.0)
            self._end_loop()

    def __enter__(self) -> Gateway:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    async def _start(self, node: Node) -> None:
        import grpc

        from tutelage.sgc.proxies.grpc_calls import Calls
        from tutelage.sgc.proxies.grpc_messages import SERVICE, methods

        calls = self._calls = Calls(node, self._loop)
        behaviours = {
            "Publish": calls.publish,
            "PublishStream": calls.publish_stream,
            "Subscribe": calls.subscribe,
            "Request": calls.request,
            "Serve": calls.serve,
            "Peers": calls.peers,
        }
        handlers = {}
        for name, (client_streams, server_streams, asked, answered) in methods().items():
            ways = ("stream" if streams else "unary" for streams in (client_streams, server_streams))
            handler = getattr(grpc, "_".join((*ways, "rpc_method_handler")))
            handlers[name] = handler(
                behaviours[name], request_deserializer=asked.FromString, response_serializer=answered.SerializeToString
            )
        self._server = grpc.aio.server(
            interceptors=(_token_check(self._token),) if self._token is not None else (),
            options=(
                ("grpc.max_receive_message_length", MAX_MESSAGE),
                ("grpc.max_send_message_length", MAX_MESSAGE),
                ("grpc.so_reuseport", 0),  # or a second gateway would share the port, and the clients, unnoticed
            ),
            maximum_concurrent_rpcs=MAX_CALLS,
        )
        self._server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, handlers),))
        try:
            if self._tls is None:
                port = self._server.add_insecure_port(self._listen)
            else:
                certificate, key, clients = self._tls.read()
                credentials = grpc.ssl_server_credentials([(key, certificate)], clients, clients is not None)
                port = self._server.add_secure_port(self._listen, credentials)
        except RuntimeError as error:
            raise ConfigError(f"cannot listen on {self._listen}: {str(error)[:200]}") from None
        unix = self._listen.startswith("unix:")
        self.address = self._listen if unix else f"{self._listen.rpartition(':')[0]}:{port}"
        await self._server.start()

    async def _stop(self) -> None:
        if self._server is not None:
            await self._server.stop(0.5)
        if self._calls is not None:
            self._calls.close()

    def _end_loop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)
        if not self._thread.is_alive():
            self._loop.close()


def _token_check(token: str) -> Any:
    import grpc

    async def refuse(request: Any, context: Any) -> None:
        await context.abort(grpc.StatusCode.UNAUTHENTICATED, "the token is missing or wrong")

    refusal = grpc.unary_unary_rpc_method_handler(refuse)

    class TokenCheck(grpc.aio.ServerInterceptor):  # type: ignore[misc]
        """Lets only calls with the token through."""

        async def intercept_service(self, continuation: Any, details: Any) -> Any:
            given = [str(value) for key, value in details.invocation_metadata if key == "authorization"]
            return await continuation(details) if has_token(given, token) else refusal

    return TokenCheck()


def _check(tls: Tls) -> None:
    """gRPC's library says of files that it cannot use only that it cannot listen."""
    tls.context()
    public = x509.load_pem_x509_certificate(tls.certificate.read_bytes()).public_key()
    if isinstance(public, Ed25519PublicKey):
        raise ConfigError(
            f"{tls.certificate} is Ed25519, as the nodes' own are, which gRPC's library does not take; use ECDSA or RSA"
        )
