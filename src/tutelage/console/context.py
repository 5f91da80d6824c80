"""What the parts of the web application share."""

from __future__ import annotations

import asyncio
import importlib.util
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from fastapi import HTTPException, Request

from tutelage.console.accounts import Accounts, Role, Session
from tutelage.console.audit import Audit
from tutelage.console.limits import is_loopback
from tutelage.console.security import COOKIE, Site
from tutelage.errors import TutelageError

if TYPE_CHECKING:
    from tutelage.console.study import Study
    from tutelage.console.supervision import Supervision

log = logging.getLogger("tutelage.console")
T = TypeVar("T")
STATIC = Path(__file__).parent / "static"


class BusyError(TutelageError):
    """Too much of one kind of work waits already."""


class Pool:
    """A few threads for one kind of work, and a bounded queue before them, so that one kind cannot starve another."""

    def __init__(self, name: str, threads: int, waiting: int) -> None:
        self._executor = ThreadPoolExecutor(threads, thread_name_prefix=f"console-{name}")
        self._free = threads + waiting

    async def run(self, call: Callable[..., T], *args: Any) -> T:
        """`call(*args)` in a thread. Raises BusyError where too many wait."""
        if self._free <= 0:
            raise BusyError("too busy; try again")
        self._free -= 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._executor, lambda: call(*args))
        finally:
            self._free += 1

    def close(self) -> None:
        """End its threads once they are done."""
        self._executor.shutdown(wait=False, cancel_futures=True)


@dataclass
class Context:
    """What the parts of the web application share.

    Attributes:
        supervision: the loop, the people and the robots.
        accounts: who may use it.
        audit: the record.
        site: where it is.
        static: folder of the built page.
        host: the address on which the server listens.
        study: the session of a user study, whose robots change from part to part; None: there is no study.
        logins: threads that hash passwords.
        control: those that carry out what people ask.
        stops: those of emergency stops, which wait for nothing else.
        slow: those that read the record and episodes.
        verifying: the one that waits for a verification of the record.
    """

    supervision: Supervision
    accounts: Accounts
    audit: Audit
    site: Site = field(default_factory=Site)
    static: Path = STATIC
    host: str = "127.0.0.1"
    study: Study | None = None
    logins: Pool = field(default_factory=lambda: Pool("login", 2, 16))
    control: Pool = field(default_factory=lambda: Pool("control", 4, 256))
    stops: Pool = field(default_factory=lambda: Pool("stops", 2, 256))
    slow: Pool = field(default_factory=lambda: Pool("slow", 2, 32))
    verifying: Pool = field(default_factory=lambda: Pool("verifying", 1, 4))

    def close(self) -> None:
        """End the threads."""
        for pool in (self.logins, self.control, self.stops, self.slow, self.verifying):
            pool.close()


def has_webrtc() -> bool:
    """Whether the extra for pictures by WebRTC is installed."""
    return importlib.util.find_spec("aiortc") is not None


def context_of(request: Request) -> Context:
    """The context of the application that serves this request."""
    context: Context = request.app.state.context
    return context


def session_of(request: Request) -> Session:
    """Who asks. Raises HTTPException 401."""
    token = request.cookies.get(COOKIE)
    session = context_of(request).accounts.session(token) if token else None
    if session is None:
        raise HTTPException(401, "log in first")
    return session


def at_least(role: Role) -> Callable[[Request], Session]:
    """A dependency: who asks, if they have this role or a higher one, else HTTPException 401 or 403."""

    def who(request: Request) -> Session:
        session = session_of(request)
        if session.role < role:
            raise HTTPException(403, f"only for {role.name.lower()}s")
        return session

    return who


def address_of(request: Request) -> str:
    """The address of the other end of the connection. Headers of proxies are not believed."""
    return request.client.host if request.client else ""


def local(request: Request) -> bool:
    """Whether the request comes from this machine, and not from a proxy on it, which speaks for anybody."""
    return is_loopback(address_of(request)) and not context_of(request).site.origins
