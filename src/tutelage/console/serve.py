"""`tutelage serve`: the loop, the people and the web application in one process."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import ssl
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from tutelage.errors import ConfigError, MissingExtraError
from tutelage.files import claimed

try:
    import uvicorn
except ModuleNotFoundError:
    raise MissingExtraError("uvicorn", "console") from None

from tutelage.console.accounts import Accounts
from tutelage.console.app import create_app
from tutelage.console.audit import Audit
from tutelage.console.context import Context
from tutelage.console.limits import is_loopback
from tutelage.console.messages import LONGEST
from tutelage.console.protocol import PatientProtocol
from tutelage.console.security import App, Site
from tutelage.console.terminal import Terminal

if TYPE_CHECKING:
    from tutelage.console.study import Study
    from tutelage.console.supervision import Supervision

Say = Callable[[str], None]

ONE_PRESS = 0.5
"""Seconds within which further signals are the first one again: a terminal and what runs us may both send it."""


@dataclass(frozen=True)
class WebConfig:
    """Where the console is.

    Attributes:
        host: address to listen on; others than this machine's own need a certificate and accounts.
        port: 0: any free one.
        certificate: PEM file of the server's certificate (and chain), for HTTPS.
        key: PEM file of its private key.
        origin: how browsers reach it through a proxy that you run in front of it, such as https://robots.example.
    """

    host: str = "127.0.0.1"
    port: int = 8800
    certificate: Path | None = None
    key: Path | None = None
    origin: str | None = None

    def site(self) -> Site:
        """What of it the checks of requests need. Raises ConfigError where it cannot work."""
        if (self.certificate is None) != (self.key is None):
            raise ConfigError("--certificate and --key are given together")
        if not is_loopback(self.host) and self.certificate is None:
            raise ConfigError(
                f"{self.host} is not this machine's own address: give --certificate and --key, or use 127.0.0.1"
            )
        origins: tuple[str, ...] = ()
        if self.origin is not None:
            parts = urlsplit(self.origin)
            if parts.scheme not in ("http", "https") or not parts.netloc or parts.path or parts.query or parts.fragment:
                raise ConfigError(f"--origin is a scheme and a name, such as https://robots.example, not {self.origin!r}")
            origins = (f"{parts.scheme}://{parts.netloc}",)
        return Site(self.certificate is not None, origins)

    def check(self) -> None:
        """Raises ConfigError where it cannot work, or certificate and key cannot be used."""
        self.site()
        if not 0 <= self.port < 2**16:
            raise ConfigError(f"--port is from 0 to 65535, not {self.port}")
        if self.certificate is None:
            return
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(self.certificate, self.key, password=lambda: "")
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"{self.certificate} and {self.key} cannot be used: {getattr(error, 'strerror', None) or error}"
            ) from None


def uvicorn_config(app: App, host: str, port: int, **options: Any) -> uvicorn.Config:
    """How the web server runs: silent clients end after 5 s, long messages are refused, nothing is believed of proxies."""
    return uvicorn.Config(
        app,
        host=host,
        port=port,
        http=PatientProtocol,
        ws_max_size=LONGEST,
        ws_ping_interval=2.0,
        ws_ping_timeout=3.0,
        ws_per_message_deflate=False,
        proxy_headers=False,
        server_header=False,
        access_log=False,
        log_config=None,
        lifespan="on",
        limit_concurrency=2048,
        timeout_keep_alive=15,
        timeout_graceful_shutdown=3,
        **options,
    )


class Server(uvicorn.Server):
    """The web server, without handlers of signals: see `Ending`."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Not here."""
        yield


class Ending:
    """What Ctrl-C and SIGTERM do, in the main thread: the first ends the web server, and lets what follows be done; a later
    one, or one before there is a server, ends the process at once. That loses nothing that is in the record, and a folder
    that is half prepared is prepared anew; an orderly end would abort, as threads may be in the middle of training.

    Attributes:
        server: the web server, as soon as it runs.
    """

    def __init__(self, say: Say) -> None:
        self.server: Server | None = None
        self._say, self._began = say, 0.0

    @contextlib.contextmanager
    def handled(self) -> Iterator[None]:
        """Install the handlers, where this is the main thread, and put the ones before back."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self._end) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _end(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if self.server and self.server.should_exit and now - self._began < ONE_PRESS:
            return
        if self.server is None or self.server.should_exit:
            os.write(sys.stderr.fileno(), b"tutelage: interrupted\n")
            os._exit(128 + number)
        self.server.should_exit, self._began = True, now
        self._say("stopping; Ctrl-C again ends it at once")


def serve(open_supervision: Callable[[Audit], Supervision | Study], out: Path, web: WebConfig, say: Say) -> None:
    """Serve until Ctrl-C or SIGTERM.

    Args:
        open_supervision: makes the fleet and its loop, which take their time and have not begun; or a session of a study,
            whose participant begins it.
        out: folder of the accounts and the record.
        web: where.
        say: takes lines for the person at the terminal.

    Raises:
        ConfigError: the address, the certificate or the folder cannot be used, or accounts are missing.
    """
    web.check()
    site = web.site()
    with contextlib.ExitStack() as stack:
        stack.enter_context(_only_one(out))
        accounts = stack.enter_context(contextlib.closing(Accounts(out)))
        invitation = accounts.invite()
        if invitation and (not is_loopback(web.host) or site.origins):
            raise ConfigError(f"make an account first: tutelage accounts add NAME --role admin --out {out}")
        listening = stack.enter_context(_listen(web.host, web.port))
        audit = stack.enter_context(contextlib.closing(Audit(out)))
        ending = Ending(say)
        stack.enter_context(ending.handled())
        opened = stack.enter_context(contextlib.closing(open_supervision(audit)))
        study = None if hasattr(opened, "start") else opened
        supervision = opened.supervision if hasattr(opened, "supervision") else opened
        app = create_app(Context(supervision, accounts, audit, site, host=web.host, study=study))
        files = {"ssl_certfile": web.certificate, "ssl_keyfile": web.key} if site.tls else {}
        server = Server(uvicorn_config(app, web.host, web.port, **files))
        if not study:
            supervision.subscribe(Terminal(supervision.description.robots, say).hear)
            supervision.start()
        audit.write("server", "server", action="start", pid=os.getpid())
        ending.server = server  # before people are told that Ctrl-C ends it
        _greet(say, site, listening, invitation)
        server.run(sockets=[listening])
        say("stopping: robots hold, everything is written down")
        audit.write("server", "server", action="stop")


def _greet(say: Say, site: Site, listening: socket.socket, invitation: str | None) -> None:
    host, port = listening.getsockname()[:2]
    name = f"[{host}]" if ":" in host else host
    address = site.origins[0] if site.origins else f"{'https' if site.tls else 'http'}://{name}:{port}"
    if invitation:
        say(f"console: {address}/#/setup/{invitation}")
        say("open this link once to make the first account; it works for an hour, on this machine only")
    else:
        say(f"console: {address}")
        say("open it in a browser and log in; accounts: tutelage accounts --help")
    say("Ctrl-C ends it")


@contextlib.contextmanager
def _only_one(folder: Path) -> Iterator[None]:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = os.open(folder / "server.lock", os.O_RDWR | os.O_CREAT, 0o600)
    except OSError as error:
        raise ConfigError(f"cannot use the folder {folder}: {error.strerror}") from None
    try:
        if not claimed(file):
            raise ConfigError(f"another server uses {folder}; give another --out")
        yield
    finally:
        os.close(file)


def _listen(host: str, port: int) -> socket.socket:
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0][0]
        return socket.create_server((host, port), family=family, backlog=512)
    except (OSError, OverflowError) as error:
        number = getattr(error, "errno", None)
        why = os.strerror(number) if number and number > 0 else error
        raise ConfigError(f"cannot listen on {host} port {port}: {why}") from None
