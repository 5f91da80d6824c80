"""What every request must pass and every answer carries: origin, host, size, headers, and who is asking."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

from tutelage.console.limits import is_loopback

COOKIE = "tutelage_session"
BODY_MAX = 65536
Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

CONTENT_SECURITY_POLICY = "; ".join(
    f"{name} {value}"
    for name, value in {
        "default-src": "'none'",
        "script-src": "'self'",
        "style-src": "'self'",
        "img-src": "'self' blob: data:",
        "media-src": "'self' blob:",
        "connect-src": "'self'",
        "font-src": "'self'",
        "frame-ancestors": "'none'",
        "base-uri": "'none'",
        "form-action": "'self'",
    }.items()
)
HEADERS = {
    "content-security-policy": CONTENT_SECURITY_POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=(), payment=(), usb=(), gamepad=(self), fullscreen=(self)",
}


@dataclass(frozen=True)
class Site:
    """Where the server is.

    Attributes:
        tls: whether it speaks HTTPS.
        origins: further origins that are its own, such as that of a proxy in front of it: "https://robots.example".
    """

    tls: bool = False
    origins: tuple[str, ...] = field(default=())

    @property
    def secure(self) -> bool:
        """Whether browsers reach it by HTTPS only."""
        return self.tls or any(origin.startswith("https://") for origin in self.origins)

    def knows_host(self, host: str) -> bool:
        """Whether a request for this host is meant for this server.

        Under TLS the certificate decides. Without, only names of this machine are taken: else any page whose name was made
        to resolve to 127.0.0.1 could talk to it (DNS rebinding).
        """
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        return self.tls or is_loopback(name) or any(urlsplit(origin).netloc == host for origin in self.origins)

    def knows_origin(self, origin: str, scheme: str, host: str) -> bool:
        """Whether a page of this origin is the server's own."""
        secure = scheme in ("https", "wss")
        return origin == f"{'https' if secure else 'http'}://{host}" or origin in self.origins


class Guard:
    """The outermost layer. HTTP: refuses strange hosts, large bodies, and requests that change something unless they carry
    an Origin of ours and `X-Tutelage: 1`; adds the headers. WebSockets: refuses strange hosts and origins."""

    def __init__(self, app: App, site: Site) -> None:
        self.app, self.site = app, site

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        refused = self._refusal(scope, headers)
        if scope["type"] == "websocket":
            if refused:
                await _refuse_socket(scope, receive, send, *refused)
            else:
                await self.app(scope, receive, send)
            return

        async def send_with_headers(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *self._headers(scope, message)]
            await send(message)

        if refused:
            await _answer(send_with_headers, *refused)
            return
        await self.app(scope, _limited(receive, send_with_headers), send_with_headers)

    def _refusal(self, scope: Scope, headers: dict[str, str]) -> tuple[int, str] | None:
        host = headers.get("host", "")
        if not self.site.knows_host(host):
            return 421, "this server is not known by that name"
        ours = self.site.knows_origin(headers.get("origin", ""), scope["scheme"], host)
        if scope["type"] == "websocket":
            return None if ours else (403, "a page of another site")
        if scope["method"] in ("GET", "HEAD"):
            return None
        if not ours or headers.get("sec-fetch-site", "same-origin") != "same-origin":
            return 403, "a page of another site"
        if headers.get("x-tutelage") != "1":
            return 403, "the header X-Tutelage: 1 is missing"
        if not headers.get("content-length", "0").isdigit() or int(headers.get("content-length", "0")) > BODY_MAX:
            return 413, f"more than {BODY_MAX} bytes"
        return None

    def _headers(self, scope: Scope, message: MutableMapping[str, Any]) -> Iterable[tuple[bytes, bytes]]:
        yield from ((name.encode(), value.encode()) for name, value in HEADERS.items())
        if self.site.secure:
            yield b"strict-transport-security", b"max-age=31536000"
        if not any(name.lower() == b"cache-control" for name, _ in message.get("headers", [])):
            yield b"cache-control", b"no-store"


class TooLargeError(Exception):
    """A body longer than it said."""


def _limited(receive: Receive, send: Send) -> Receive:
    read = 0

    async def limited() -> MutableMapping[str, Any]:
        nonlocal read
        message = await receive()
        read += len(message.get("body", b""))
        if read > BODY_MAX:
            raise TooLargeError
        return message

    return limited


async def _answer(send: Send, status: int, text: str) -> None:
    body = json.dumps({"error": text}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": [*headers, (b"connection", b"close")]})
    await send({"type": "http.response.body", "body": body})


async def _refuse_socket(scope: Scope, receive: Receive, send: Send, status: int, text: str) -> None:
    await receive()  # websocket.connect
    await deny_socket(scope, send, status, text)


async def deny_socket(scope: Scope, send: Send, status: int, text: str) -> None:
    """Refuse a socket that was not accepted yet, by an HTTP answer."""
    if "websocket.http.response" not in scope.get("extensions", {}):
        await send({"type": "websocket.close", "code": 1008})
        return
    body = json.dumps({"error": text}).encode()
    headers = [(b"content-type", b"application/json"), *((n.encode(), v.encode()) for n, v in HEADERS.items())]
    await send({"type": "websocket.http.response.start", "status": status, "headers": headers})
    await send({"type": "websocket.http.response.body", "body": body})
