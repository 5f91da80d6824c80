"""HTTP: the fleet, its metrics, the record, episodes, the emergency stop, the server's health."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Depends, HTTPException, Path, Query, Request, Response
from fastapi.responses import PlainTextResponse
from pydantic import BaseModel, ConfigDict

from tutelage import __version__
from tutelage.console.accounts import Role, Session
from tutelage.console.chain import Row
from tutelage.console.context import at_least, context_of, has_webrtc, local, session_of
from tutelage.console.messages import Robot
from tutelage.console.pictures import jpeg
from tutelage.console.plain import parsed, plain, text_in_pieces
from tutelage.console.verifying import verify_apart

router = APIRouter()
_NOT_IN_NAMES = re.compile("[^a-zA-Z0-9_:]")
"""Prometheus refuses all of an answer in which one name has another character, such as that of loss/risk."""
Anybody = Annotated[Session, Depends(session_of)]
Operator = Annotated[Session, Depends(at_least(Role.OPERATOR))]
Id = Annotated[int, Path(ge=0, lt=2**53)]


class Which(BaseModel):
    """A robot, or all (null)."""

    model_config = ConfigDict(extra="forbid", strict=True)

    robot: Robot | None


async def _answer(request: Request, call: Callable[[], dict[str, Any] | None]) -> Response:
    """What `call` returns as JSON. All of it is done in a thread: thousands of rows would hold up the sockets.

    Raises:
        HTTPException: 404: it returned None.
    """

    def make() -> str | None:
        found = call()
        return None if found is None else text_in_pieces(found)

    content = await context_of(request).slow.run(make)
    if content is None:
        raise HTTPException(404, "there is nothing here")
    return Response(content, media_type="application/json")


@router.get("/api/fleet")
def fleet(request: Request, who: Anybody) -> dict[str, Any]:
    """What is supervised."""
    return describe(request.app)


def describe(app: Any) -> dict[str, Any]:
    """The fleet's description, with the server's version and time."""
    said: dict[str, Any] = plain(app.state.context.supervision.description.to_json())
    return said | {"version": __version__, "server_time": time.time(), "webrtc": has_webrtc()}


@router.get("/api/metrics")
async def metrics(request: Request, who: Anybody, since: Annotated[int, Query(ge=0, lt=2**53)] = 0) -> Response:
    """Rows of metrics after timestep `since`."""
    supervision = context_of(request).supervision
    return await _answer(request, lambda: {"rows": supervision.metrics(since)})


@router.get("/api/operators")
async def operators(request: Request, who: Anybody) -> dict[str, Any]:
    """What each person has done, and who is here."""
    c, hub = context_of(request), request.app.state.hub
    rows = plain(await c.slow.run(c.supervision.operators))
    known = {row["operator"] for row in rows}
    rows += [{"operator": name} for name in sorted(hub.operators - known)]
    return {"rows": [row | {"name": row["operator"], "online": row["operator"] in hub.operators} for row in rows]}


@router.get("/api/audit")
async def audit(
    request: Request,
    who: Operator,
    before: Annotated[int | None, Query(ge=0, lt=2**62)] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    kind: Annotated[str | None, Query(max_length=32)] = None,
    person: Annotated[str | None, Query(max_length=64, alias="who")] = None,
    robot: Annotated[int | None, Query(ge=0, lt=2**31)] = None,
) -> Response:
    """The newest rows of the record."""
    record = context_of(request).audit

    def read() -> dict[str, Any]:
        rows, head = record.rows(before, limit, kind or None, person or None, robot), record.head()
        return {"rows": [_row(row) for row in rows], "head": {"rows": head.rows, "hash": head.hash.hex()}}

    return await _answer(request, read)


@router.get("/api/audit/verify")
async def verify(request: Request, who: Operator) -> dict[str, Any]:
    """Whether the record is whole."""
    c = context_of(request)
    verdict = await c.verifying.run(verify_apart, c.audit.path.parent)
    return {"ok": verdict.ok, "rows": verdict.rows, "broken_at": verdict.broken_at, "why": verdict.why, "head": verdict.head}


def _row(row: Row) -> dict[str, Any]:
    return {
        "id": row.id, "time": row.time, "kind": row.kind, "who": row.who, "robot": row.robot,
        "fields": parsed(row.fields), "hash": row.hash.hex(),
    }  # fmt: skip


@router.get("/api/episodes")
async def episodes(request: Request, who: Anybody, limit: Annotated[int, Query(ge=1, le=1000)] = 100) -> Response:
    """Recorded interventions, newest first."""
    supervision = context_of(request).supervision
    return await _answer(request, lambda: {"rows": supervision.episodes(limit)})


@router.get("/api/episodes/{id}")
async def episode(request: Request, who: Anybody, id: Id) -> Response:
    """One of them."""
    supervision = context_of(request).supervision
    return await _answer(request, lambda: supervision.episode(id))


@router.get("/api/episodes/{id}/frames/{k}.jpg")
async def episode_frame(
    request: Request,
    who: Anybody,
    id: Id,
    k: Annotated[int, Path(ge=0, lt=2**31)],
    width: Annotated[int, Query(ge=16, le=1920)] = 640,
    height: Annotated[int, Query(ge=16, le=1080)] = 360,
) -> Response:
    """A picture of it."""
    c = context_of(request)

    def draw() -> bytes | None:
        frame = c.supervision.episode_frame(id, k, width, height)
        return jpeg(frame.rgb) if frame else None

    picture = await c.slow.run(draw)
    if picture is None:
        raise HTTPException(404, "no such picture")
    return Response(picture, media_type="image/jpeg", headers={"cache-control": "private, max-age=3600"})


@router.post("/api/estop")
async def estop(request: Request, who: Operator, body: Which) -> dict[str, Any]:
    """Stop a robot, or all of them, at once."""
    c = context_of(request)
    await c.stops.run(c.supervision.estop, who.name, body.robot)
    return {}


@router.post("/api/estop/clear")
async def clear_estop(request: Request, who: Operator, body: Which) -> dict[str, Any]:
    """Let it go on."""
    c = context_of(request)
    await c.stops.run(c.supervision.clear_estop, who.name, body.robot)
    return {}


@router.get("/healthz")
def healthz(request: Request) -> Response:
    """Whether the server works; without details, as it needs no login."""
    c = context_of(request)
    ok = bool(c.supervision.healthy.get("ok")) and c.audit.error is None
    return Response('{"ok":true}' if ok else '{"ok":false}', 200 if ok else 503, media_type="application/json")


@router.get("/metrics", response_class=PlainTextResponse)
def prometheus(request: Request) -> str:
    """The server's numbers for Prometheus: for this machine without login, else for admins."""
    if not local(request):
        at_least(Role.ADMIN)(request)
    c, app = context_of(request), request.app
    numbers: dict[str, Any] = {
        f"tutelage_{name}": value for name, value in plain(c.supervision.healthy).items() if isinstance(value, int | float)
    }
    rows = c.supervision.metrics(max(0, c.supervision.snapshot().t - 1000))
    newest = plain(rows[-1]) if rows else {}
    numbers |= {f"tutelage_fleet_{name}": value for name, value in newest.items() if isinstance(value, int | float)}
    numbers |= {f"tutelage_console_{name}": value for name, value in app.state.hub.counts().items()}
    numbers |= {f"tutelage_video_{name}": value for name, value in app.state.video.counts().items()}
    if has_webrtc():
        numbers |= {f"tutelage_webrtc_{name}": value for name, value in app.state.peers.counts().items()}
    numbers["tutelage_record_error"] = int(c.audit.error is not None)
    lines = ((_NOT_IN_NAMES.sub("_", name), float(value)) for name, value in numbers.items())
    return "".join(f"# TYPE {name} gauge\n{name} {value:.15g}\n" for name, value in lines)
