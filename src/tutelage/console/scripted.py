"""Operators that are programs: they log in, are offered robots, accept, drive and give back, over the page's own sockets.

    operator = ScriptedOperator("http://127.0.0.1:8800", "ann", "correct horse")
    asyncio.run(operator.run(seconds=60))

For tests, demonstrations and the figures of chapter 5. They drive as people do who hold the key that lets the task's expert
act (`assist`), or as a function of what the page is told says.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import ssl
import struct
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

from tutelage.errors import ConfigError, MissingExtraError
from tutelage.fleet.modes import Mode

try:
    from websockets.asyncio.client import ClientConnection, connect
    from websockets.exceptions import ConnectionClosed
except ImportError as error:  # pragma: no cover - exercised in an environment without the extra
    raise MissingExtraError(error.name or "websockets", "console") from None

HEADER = struct.Struct("<IHHHHId")
"""Of a picture: robot, camera, width, height, 0, sequence, time."""
BEAT = 0.2
"""Seconds between heartbeats of a lease."""

Act = Callable[[dict[str, Any], int], Sequence[float] | None]
Rule = Callable[[dict[str, Any], int, int], bool]


def after(steps: int) -> Rule:
    """Give a robot back after so many timesteps, or when its task is complete."""
    return lambda state, robot, begin: state["t"] - begin >= steps


@dataclass
class Tally:
    """What an operator did, and how the server was for them.

    Attributes:
        offers, accepted, interventions, resets, commands, given_back: counts.
        ends: why leases ended, how often each.
        errors: codes of refusals, how often each.
        round_trips: of pings, s.
        pictures: how many came; delays: seconds from their being taken to their coming.
    """

    offers: int = 0
    accepted: int = 0
    interventions: int = 0
    resets: int = 0
    commands: int = 0
    given_back: int = 0
    ends: dict[str, int] = field(default_factory=dict)
    errors: dict[str, int] = field(default_factory=dict)
    round_trips: list[float] = field(default_factory=list)
    latency: list[float] = field(default_factory=list)
    pictures: int = 0
    delays: list[float] = field(default_factory=list)


@dataclass
class _Drive:
    """A robot in one's hands."""

    robot: int
    lease: str
    begin: int | None = None
    reset_asked: bool = False
    give_back_asked: bool = False


class ScriptedOperator:
    """Somebody at a console.

    Args:
        address: of the server, such as http://127.0.0.1:8800.
        name, password: of an account with the role operator or admin.
        react: seconds until an offer is accepted.
        act: the action for a robot from the newest message "state" and its index; None, or where it returns None: the
            expert acts (`assist`).
        rule: when to give a robot back: from the newest state, the robot, and the timestep at which they began.
        streams: pictures to watch meanwhile, as in the message "watch".
        rate: commands a second; default: those of the fleet.
        context: for https.
    """

    def __init__(
        self,
        address: str,
        name: str,
        password: str,
        react: float = 0.3,
        act: Act | None = None,
        rule: Rule | None = None,
        streams: Sequence[dict[str, Any]] = (),
        rate: float | None = None,
        context: ssl.SSLContext | None = None,
    ) -> None:
        parts = urlsplit(address)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ConfigError(f"{address!r} is no address of a console; write http://HOST:PORT")
        self.address, self.name, self._password = address.rstrip("/"), name, password
        self._react, self._act, self._rule, self._streams, self._rate = react, act, rule or after(20), streams, rate
        self._tls = parts.scheme == "https"
        self._context = context
        self._cookie = ""
        self._state: dict[str, Any] = {}
        self._fleet: dict[str, Any] = {}
        self._drive: _Drive | None = None
        self._accepting: asyncio.Task[None] | None = None
        self._offered: dict[int, float] = {}
        self._seq = self._ref = 0
        self.tally = Tally()
        self.rows: list[dict[str, Any]] = []
        """The rows of metrics that were told."""

    # -- the way in ---------------------------------------------------------------------------------------------

    def log_in(self) -> None:
        """Get a session.

        Raises:
            ConfigError: wrong name or password, or no server there.
        """
        status, answer, cookie = self._request("POST", "/api/login", {"name": self.name, "password": self._password})
        if status != 200 or not cookie:
            raise ConfigError(f"{self.name} cannot log in at {self.address}: {answer.get('error', status)}")
        self._cookie = cookie.partition(";")[0]

    def get(self, path: str) -> dict[str, Any]:
        """A GET of the API, such as "/api/metrics"."""
        return self._request("GET", path)[1]

    def _request(self, method: str, path: str, body: Any = None) -> tuple[int, dict[str, Any], str]:
        parts = urlsplit(self.address)
        host, port = str(parts.hostname), parts.port
        if self._tls:
            connection: http.client.HTTPConnection = http.client.HTTPSConnection(
                host, port, timeout=15, context=self._context
            )
        else:
            connection = http.client.HTTPConnection(host, port, timeout=15)
        headers = {"X-Tutelage": "1", "Origin": self.address, "Content-Type": "application/json", "Cookie": self._cookie}
        try:
            connection.request(method, path, None if body is None else json.dumps(body), headers)
            response = connection.getresponse()
            content = json.loads(response.read() or b"{}")
            return response.status, content, response.getheader("Set-Cookie") or ""
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise ConfigError(f"no console answers at {self.address}: {error}") from None
        finally:
            connection.close()

    @asynccontextmanager
    async def _socket(self, path: str) -> AsyncIterator[ClientConnection]:
        address = self.address.replace("http", "ws", 1) + path
        async with connect(
            address, origin=self.address, additional_headers={"Cookie": self._cookie}, max_size=2**24,  # type: ignore[arg-type]
            compression=None, ssl=self._context if self._tls else None,
        ) as socket:  # fmt: skip
            yield socket

    # -- work ---------------------------------------------------------------------------------------------------

    async def run(self, seconds: float | None = None, until: Callable[[], bool] = lambda: False) -> Tally:
        """Work for so long, or until that is true; then give back what one has.

        Raises:
            ConfigError: no session, or the server ended it.
        """
        await asyncio.to_thread(self.log_in)
        end = time.monotonic() + seconds if seconds is not None else float("inf")
        try:
            async with self._socket("/api/live") as live, contextlib.AsyncExitStack() as stack:
                tasks = [asyncio.create_task(self._listen(live)), asyncio.create_task(self._work(live))]
                if self._streams:
                    video = await stack.enter_async_context(self._socket("/api/video"))
                    tasks.append(asyncio.create_task(self._watch(video)))
                while time.monotonic() < end and not until() and not any(task.done() for task in tasks):
                    await asyncio.sleep(0.02)
                if self._accepting is not None:
                    tasks.append(self._accepting)
                for task in tasks:
                    task.cancel()
                for result in await asyncio.gather(*tasks, return_exceptions=True):
                    if isinstance(result, Exception):
                        raise result
                if self._drive is not None:
                    await self._say(live, type="give_back", robot=self._drive.robot)
        except (ConnectionClosed, OSError) as error:
            raise ConfigError(f"the console at {self.address} ended the connection: {error}") from None
        return self.tally

    async def _listen(self, live: ClientConnection) -> None:
        async for text in live:
            message = json.loads(text)
            kind = message["type"]
            if kind == "state":
                self._state = message
            elif kind == "hello":
                self._fleet = message["fleet"]
            elif kind == "offer":
                self.tally.offers += 1
                self._offered[message["robot"]] = time.monotonic() + (message.get("expires_in") or 0.0)
                self._consider(live)
            elif kind == "lease":
                self.tally.interventions += 1
                self._drive = _Drive(message["robot"], message["id"])
            elif kind == "lease_end":
                self.tally.ends[message["why"]] = self.tally.ends.get(message["why"], 0) + 1
                if self._drive is not None and self._drive.lease == message.get("id", self._drive.lease):
                    self.tally.resets += message["why"] == "reset_done"
                    self._drive = None
                    self._consider(live)
            elif kind == "error":
                self.tally.errors[message["code"]] = self.tally.errors.get(message["code"], 0) + 1
            elif kind == "pong":
                self.tally.round_trips.append(time.monotonic() - message["time"])
            elif kind == "metrics":
                self.rows.append(message["row"])
            elif kind == "link" and message["command_latency_ms"]["p99"] is not None:
                self.tally.latency.append(message["command_latency_ms"]["p99"])

    def _consider(self, live: ClientConnection) -> None:
        """Accept what is offered, soon; an offer may come before the news that the robot before it is gone."""
        if self._accepting is None or self._accepting.done():
            self._accepting = asyncio.create_task(self._accept(live))

    async def _accept(self, live: ClientConnection) -> None:
        await asyncio.sleep(self._react)
        now = time.monotonic()
        open_now = [robot for robot, expires in self._offered.items() if expires > now]
        if self._drive is None and open_now:
            self._offered = {}  # one at a time; whoever else asks will be offered again
            self.tally.accepted += 1
            with contextlib.suppress(ConnectionClosed):
                await self._say(live, type="accept", robot=open_now[-1])

    async def _work(self, live: ClientConnection) -> None:
        """Heartbeats, and commands at the fleet's rate."""
        beat = ping = 0.0
        while True:
            now = time.monotonic()
            if now - ping >= 1.0:
                ping = now
                await live.send(json.dumps({"type": "ping", "n": self._ref, "time": now}))
            drive = self._drive
            if drive is not None and self._state:
                if now - beat >= BEAT:
                    beat = now
                    await live.send(json.dumps({"type": "renew", "lease": drive.lease}))
                await self._handle(live, drive)
            await asyncio.sleep(1.0 / (self._rate or self._fleet.get("hz", 10.0)))

    async def _handle(self, live: ClientConnection, drive: _Drive) -> None:
        state = self._state
        lease = state["leases"].get(str(drive.robot))
        mode = state["mode"][drive.robot]
        if lease is None or lease["id"] != drive.lease:
            return  # a state from before the lease, or after it
        if drive.begin is None:
            drive.begin = state["t"]
        if mode == Mode.SWITCHING and state["reason"][drive.robot] == "violated":
            if not drive.reset_asked:
                drive.reset_asked = True
                await self._say(live, type="reset", robot=drive.robot)
            return
        if mode == Mode.RESETTING:
            return
        if self._rule(state, drive.robot, drive.begin):
            if not drive.give_back_asked:
                drive.give_back_asked = True
                self.tally.given_back += 1
                await self._say(live, type="give_back", robot=drive.robot)
            return
        action = None if self._act is None else self._act(state, drive.robot)
        self._seq += 1
        self.tally.commands += 1
        command = {
            "type": "command", "robot": drive.robot, "lease": drive.lease, "seq": self._seq, "sent": time.time() * 1000,
            "action": None if action is None else [float(x) for x in action], "assist": action is None, "push": None,
        }  # fmt: skip
        await live.send(json.dumps(command))

    async def _say(self, live: ClientConnection, **message: Any) -> None:
        self._ref += 1
        await live.send(json.dumps({**message, "ref": self._ref}))

    async def _watch(self, video: ClientConnection) -> None:
        await video.send(json.dumps({"type": "watch", "streams": list(self._streams)}))
        async for message in video:
            if isinstance(message, bytes):
                sequence, taken = HEADER.unpack_from(message)[5:7]
                self.tally.pictures += 1
                self.tally.delays.append(time.time() - taken)
                await video.send(json.dumps({"type": "got", "sequence": sequence}))
