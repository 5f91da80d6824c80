"""A running console for tests, on a free port of this machine, and clients of it."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import httpx
import uvicorn
from small_supervision import SmallSupervision
from websockets.sync.client import ClientConnection, connect

from tutelage.console.accounts import Accounts, Role
from tutelage.console.app import create_app
from tutelage.console.audit import Audit
from tutelage.console.context import STATIC, Context
from tutelage.console.passwords import Passwords
from tutelage.console.security import Site
from tutelage.console.serve import uvicorn_config

PASSWORD = "correct horse battery"


class Running:
    """A server, and what it stands on."""

    def __init__(
        self, folder: Path, open_supervision: Callable[[Audit], Any] = SmallSupervision, static: Path = STATIC
    ) -> None:
        self.folder = folder
        self.audit = Audit(folder)
        self.accounts = Accounts(folder, Passwords(time_cost=1, memory_cost=1024))
        if not self.accounts.all():
            for name, role in {
                "viewer": Role.VIEWER,
                "operator": Role.OPERATOR,
                "admin": Role.ADMIN,
                "ana": Role.OPERATOR,
            }.items():
                self.accounts.add(name, role, PASSWORD)
        self.supervision = open_supervision(self.audit)
        study = None if hasattr(self.supervision, "start") else self.supervision
        if study is None:
            self.supervision.start()
        now = study.supervision if study else self.supervision
        self.context = Context(now, self.accounts, self.audit, Site(), static, study=study)
        self.server = uvicorn.Server(uvicorn_config(create_app(self.context), "127.0.0.1", 0))
        self._thread = threading.Thread(target=self.server.run, daemon=True)
        self._thread.start()
        deadline = time.monotonic() + 20
        while not self.server.started:
            assert time.monotonic() < deadline, "the server does not start"
            time.sleep(0.01)
        self.port = self.server.servers[0].sockets[0].getsockname()[1]
        self.origin = f"http://127.0.0.1:{self.port}"

    def close(self) -> None:
        self.server.should_exit = True
        self._thread.join(20)
        self.supervision.close()
        self.audit.close()
        self.accounts.close()

    def client(self, name: str | None = None, **headers: str) -> httpx.Client:
        """An HTTP client that behaves as the page does; logged in where a name is given."""
        usual = {"origin": self.origin, "x-tutelage": "1"} | headers
        client = httpx.Client(base_url=self.origin, headers=usual, timeout=20)
        if name:
            answer = client.post("/api/login", json={"name": name, "password": PASSWORD})
            assert answer.status_code == 200, answer.text
        return client

    def cookie(self, name: str) -> str:
        """The session cookie of a new session."""
        with contextlib.closing(self.client(name)) as client:
            return f"tutelage_session={client.cookies['tutelage_session']}"

    def numbers(self) -> dict[str, float]:
        """What /metrics says."""
        lines = httpx.get(f"{self.origin}/metrics").text.splitlines()
        return {name: float(value) for name, value in (line.split() for line in lines if not line.startswith("#"))}

    @contextlib.contextmanager
    def socket(self, name: str, path: str = "/api/live", cookie: str | None = None, **options: Any) -> Iterator[Socket]:
        """A socket of somebody."""
        headers = {"cookie": cookie or self.cookie(name)}
        uri = f"ws://127.0.0.1:{self.port}{path}"
        with connect(
            uri, origin=self.origin, additional_headers=headers, max_size=2**24, close_timeout=1, **options
        ) as connection:  # type: ignore[arg-type]
            yield Socket(connection)


class Socket:
    """A socket of the page."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.seen: list[dict[str, Any]] = []

    def say(self, type: str, **fields: Any) -> None:
        self.connection.send(json.dumps({"type": type, **fields}))

    def hear(self, type: str, timeout: float = 5.0, **fields: Any) -> dict[str, Any]:
        """The next message of a type (and with these fields); others are kept in `seen`."""
        return self.hear_any((type,), timeout, **fields)

    def heard(self, type: str, **fields: Any) -> dict[str, Any]:
        """The same, if it did not come before."""
        before = [m for m in self.seen if m["type"] == type and fields.items() <= m.items()]
        return before[-1] if before else self.hear(type, **fields)

    def hear_any(self, types: Sequence[str], timeout: float = 5.0, **fields: Any) -> dict[str, Any]:
        """The same for several types."""
        deadline = time.monotonic() + timeout
        while True:
            left = deadline - time.monotonic()
            assert left > 0, (
                f"no {types} {fields} came, but {[m for m in self.seen if m['type'] not in ('hello', 'state', 'metrics')]}"
            )
            try:
                message = json.loads(self.connection.recv(left))
            except TimeoutError:
                continue
            self.seen.append(message)
            if message["type"] in types and fields.items() <= message.items():
                return dict(message)

    def closed(self, timeout: float = 10.0) -> int:
        """The code with which the server closes it."""
        deadline = time.monotonic() + timeout
        try:
            while time.monotonic() < deadline:
                with contextlib.suppress(TimeoutError):
                    self.connection.recv(0.5)
        except Exception:
            pass
        assert self.connection.protocol.close_code is not None, "the server did not close the socket"
        return self.connection.protocol.close_code
