"""`/healthz` and `/metrics` over HTTP, on loopback.

`/healthz` answers 200 while the node is connected to a router, holds its topics' keys, and its certificate is valid for
another five minutes; else 503. The body says why, in JSON.
"""

from __future__ import annotations

import json
import logging
import re
import sys
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Self

from tutelage.errors import ConfigError
from tutelage.sgc.health import Tree, prometheus

log = logging.getLogger(__name__)


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that hangs up, or says nothing, is none of our faults; anything else is logged."""
        if not isinstance(sys.exception(), OSError):
            log.exception("health, as asked by %s", client_address)


class HealthServer:
    """Serves `/healthz` and `/metrics`."""

    def __init__(self, address: str, health: Callable[[], Tree], metrics: Callable[[], Tree]) -> None:
        """
        Args:
            address: HOST:PORT; loopback unless somebody else is meant to see how many messages go where.

        Raises:
            ConfigError: the address is impossible or in use.
        """
        host, _, port = address.rpartition(":")
        if not host or not re.fullmatch(r"[0-9]{1,5}", port) or int(port) > 65535:
            raise ConfigError(f"{address!r} is no address to serve health on; write HOST:PORT, such as 127.0.0.1:9090")

        class Handler(BaseHTTPRequestHandler):
            timeout = 5.0

            def do_GET(self) -> None:
                path = self.path.partition("?")[0]
                if path == "/healthz":
                    state = health()
                    self._answer(200 if state["ok"] else 503, "application/json", json.dumps(state) + "\n")
                elif path == "/metrics":
                    self._answer(200, "text/plain; version=0.0.4; charset=utf-8", prometheus(metrics()))
                else:
                    self._answer(404, "text/plain; charset=utf-8", "there are /healthz and /metrics\n")

            def _answer(self, code: int, kind: str, text: str) -> None:
                body = text.encode()
                self.send_response(code)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: Any) -> None:
                return

        try:
            self._server = _Server((host.strip("[]"), int(port)), Handler)
        except (OSError, UnicodeError) as error:  # a name with a label that is too long is no text for the resolver
            why = error.strerror if isinstance(error, OSError) else error
            raise ConfigError(f"cannot serve health on {address}: {why}") from None
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.2,), name="sgc-health", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.server_address[1])

    def close(self) -> None:
        """Stop."""
        self._server.shutdown()
        self._server.server_close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
