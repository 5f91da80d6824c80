"""The web application: routes, sockets and errors put together."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator

from tutelage.errors import MissingExtraError, TutelageError

try:
    from fastapi import FastAPI, Request
    from fastapi.exceptions import RequestValidationError
    from fastapi.responses import JSONResponse
    from starlette.exceptions import HTTPException
    from starlette.websockets import WebSocket
except ModuleNotFoundError:
    raise MissingExtraError("fastapi", "console") from None

from tutelage.console import account_api, fleet_api, site
from tutelage.console.audit import RecordError
from tutelage.console.context import BusyError, Context, has_webrtc, log
from tutelage.console.hub import Hub
from tutelage.console.live import LiveSocket
from tutelage.console.messages import problem
from tutelage.console.security import App, Guard, deny_socket
from tutelage.console.sockets import Socket, admit
from tutelage.console.states import Denied
from tutelage.console.video import Video, VideoSocket


def create_app(context: Context) -> App:
    """The ASGI application over a supervision that has begun."""
    hub, video = Hub(context), Video(context)
    sockets: set[Socket] = set()

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        hub.start()
        try:
            yield
        finally:
            await video.stop()
            if has_webrtc():
                await app.state.peers.stop()
            await hub.stop()
            context.close()

    app = FastAPI(title="Tutelage", lifespan=lifespan, openapi_url=None, docs_url=None, redoc_url=None)
    app.state.context, app.state.hub, app.state.video = context, hub, video
    app.state.files, app.state.sockets = site.read(context.static), sockets
    app.include_router(account_api.router)
    app.include_router(fleet_api.router)

    if has_webrtc():
        from tutelage.console import webrtc

        app.state.peers = webrtc.Peers(context, context.host)
        app.include_router(webrtc.router)
    if context.study:
        from tutelage.console import study_api

        app.include_router(study_api.router)

    async def run(socket: Socket) -> None:
        sockets.add(socket)
        try:
            await socket.serve()
        finally:
            sockets.discard(socket)

    @app.websocket("/api/live")
    async def live(websocket: WebSocket) -> None:
        session = await admit(websocket, context, LiveSocket)
        if session:
            await run(LiveSocket(websocket, hub, session))

    @app.websocket("/api/video")
    async def watch(websocket: WebSocket) -> None:
        session = await admit(websocket, context, VideoSocket)
        if session:
            await run(VideoSocket(websocket, video, session))

    @app.websocket("/{path:path}")
    async def nothing(websocket: WebSocket) -> None:
        await websocket.receive()
        await deny_socket(websocket.scope, websocket.send, 404, "there is nothing here")

    _answer_errors(app)
    app.include_router(site.router)  # takes every other path
    return Guard(app, context.site)


def _answer_errors(app: FastAPI) -> None:
    """Every error is JSON {"error": one line}, and repeats nothing of the request."""

    @app.exception_handler(HTTPException)
    async def http(request: Request, error: HTTPException) -> JSONResponse:
        return JSONResponse({"error": error.detail}, error.status_code, error.headers)

    @app.exception_handler(RequestValidationError)
    async def malformed(request: Request, error: RequestValidationError) -> JSONResponse:
        return JSONResponse({"error": problem(error.errors()[0])}, 422)

    @app.exception_handler(TutelageError)
    async def ours(request: Request, error: TutelageError) -> JSONResponse:
        if isinstance(error, Denied):
            return JSONResponse({"error": error.text, "code": error.code}, 409)
        return JSONResponse({"error": str(error)}, 503 if isinstance(error, RecordError | BusyError) else 400)

    @app.exception_handler(Exception)
    async def unexpected(request: Request, error: Exception) -> JSONResponse:
        log.error("%s %s failed", request.method, request.url.path, exc_info=error)
        return JSONResponse({"error": "an error of the server; its log says more"}, 500)
