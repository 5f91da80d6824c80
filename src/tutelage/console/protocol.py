"""HTTP connections that do not last for ever: a stranger who says half a request, or opens hundreds, holds nothing up."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from tutelage.console.limits import network_of

REQUEST_SECONDS = 10.0
"""How long a request may take to arrive."""
EACH_MAX = 256
"""Requests of one place at a time; sockets are limited by account."""
_open: Counter[str] = Counter()


class PatientProtocol(HttpToolsProtocol):
    """As uvicorn's, but a request must be there in time, and one place has a limited number of connections."""

    _place = ""
    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._place = network_of(self.client[0] if self.client else "")
        _open[self._place] += 1
        if _open[self._place] > EACH_MAX:
            transport.abort()
            return
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        self._arrived()
        self._gone()
        super().connection_lost(exc)

    def on_message_begin(self) -> None:
        self._wait()
        super().on_message_begin()

    def on_message_complete(self) -> None:
        self._arrived()
        super().on_message_complete()

    def handle_websocket_upgrade(self) -> None:
        self._arrived()
        self._gone()  # the socket's own protocol takes over; sockets are limited by account
        super().handle_websocket_upgrade()

    def _wait(self) -> None:
        self._arrived()
        self._late = self.loop.call_later(REQUEST_SECONDS, self.transport.abort)

    def _arrived(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None

    def _gone(self) -> None:
        if self._place:
            _open[self._place] -= 1
            if not _open[self._place]:
                del _open[self._place]
            self._place = ""
