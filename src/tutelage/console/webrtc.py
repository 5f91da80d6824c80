"""Pictures by WebRTC, an extra: for links where a congested TCP connection would stutter. No public server is asked.

The page makes the offer. Its candidates are not believed: the server sends to the address from which the request came, and
nowhere else, and tells candidates of the address on which it listens, and of no other.
"""

from __future__ import annotations

import asyncio
import contextlib
import fractions
import time
from collections import Counter
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, HTTPException, Request
from pydantic import BaseModel, ConfigDict, Field

from tutelage.console.accounts import Session
from tutelage.console.context import Context, Pool, address_of, context_of, log, session_of
from tutelage.console.limits import is_loopback
from tutelage.console.messages import Robot
from tutelage.console.pictures import decoded, fitted
from tutelage.errors import MissingExtraError

try:
    import aioice.ice
    import av
    from aiortc import MediaStreamTrack, RTCConfiguration, RTCPeerConnection, RTCSessionDescription
except ModuleNotFoundError as missing:
    raise MissingExtraError(missing.name or "aiortc", "webrtc") from None

router = APIRouter(prefix="/api")
Anybody = Annotated[Session, Depends(session_of)]
EACH_MAX, ALL_MAX = 30, 60
"""Streams of one person, and of all."""
CLOCK = 90_000


class Offer(BaseModel):
    """A stream that a page wants."""

    model_config = ConfigDict(extra="forbid", strict=True)

    sdp: Annotated[str, Field(max_length=32_768)]
    type: Literal["offer"]
    robot: Robot
    camera: Annotated[int, Field(ge=0, lt=2**16)] = 0
    width: Annotated[int, Field(ge=16, le=1920)] = 640
    height: Annotated[int, Field(ge=16, le=1080)] = 360
    fps: Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)] = 20.0


class RobotTrack(MediaStreamTrack):
    """The pictures of one camera, the newest each time; black until there is one."""

    kind = "video"

    def __init__(self, context: Context, pool: Pool, offer: Offer) -> None:
        super().__init__()
        self._context, self._pool, self._offer = context, pool, offer
        self._began, self._count = time.monotonic(), 0

    async def recv(self) -> Any:
        """The next frame, when it is due."""
        self._count += 1
        due = self._began + self._count / self._offer.fps
        if due < time.monotonic() - 1:  # no hurrying after a stall
            self._count = int((time.monotonic() - self._began) * self._offer.fps)
        await asyncio.sleep(max(0.0, due - time.monotonic()))
        frame = await self._pool.run(self._frame)
        frame.pts = int((time.monotonic() - self._began) * CLOCK)
        frame.time_base = fractions.Fraction(1, CLOCK)
        return frame

    def _frame(self) -> Any:
        o, supervision = self._offer, self._context.supervision
        sent = supervision.jpeg(o.robot, o.camera)
        taken = None if sent else supervision.frame(o.robot, o.camera, o.width, o.height)
        rgb = decoded(sent[1]) if sent else taken.rgb if taken else None
        if rgb is None:
            black = av.VideoFrame(o.width // 2 * 2, o.height // 2 * 2, "yuv420p")
            for k, plane in enumerate(black.planes):
                plane.update(bytes([0 if k == 0 else 128]) * plane.buffer_size)
            return black
        rgb = fitted(rgb, o.width, o.height)
        even = rgb[: rgb.shape[0] // 2 * 2, : rgb.shape[1] // 2 * 2]
        return av.VideoFrame.from_ndarray(even.copy(), format="rgb24")


class Peers:
    """All connections."""

    def __init__(self, context: Context, host: str) -> None:
        """host: the address on which the server listens."""
        self.context = context
        self._pool = Pool("webrtc", 2, 4 * ALL_MAX)
        self._of: Counter[str] = Counter()
        self._tasks: dict[Any, asyncio.Task[None]] = {}
        if host not in ("0.0.0.0", "::"):
            # The library offers every address of the machine, and none of the loopback interface.
            aioice.ice.get_host_addresses = lambda use_ipv4, use_ipv6: ["127.0.0.1" if is_loopback(host) else host]

    async def answer(self, session: Session, offer: Offer, address: str) -> str:
        """The SDP of the answer.

        Raises:
            HTTPException: 400: no such robot, or not an offer for video; 429: too many streams.
        """
        description = self.context.supervision.description
        if offer.robot >= len(description.robots) or offer.camera >= max(1, len(description.cameras)):
            raise HTTPException(400, f"no robot {offer.robot} with camera {offer.camera}")
        if self._of[session.name] >= EACH_MAX or self._of.total() >= ALL_MAX:
            raise HTTPException(429, "too many streams")
        self._of[session.name] += 1
        peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        try:
            sdp = believed(offer.sdp, address)
            await peer.setRemoteDescription(RTCSessionDescription(sdp, "offer"))
            if [transceiver.kind for transceiver in peer.getTransceivers()] != ["video"]:
                raise ValueError("an offer for one video is wanted")
            peer.addTrack(RobotTrack(self.context, self._pool, offer))
            await peer.setLocalDescription(await peer.createAnswer())
        except Exception as error:  # the library raises of many kinds for what strangers may write
            await self._end(peer, session.name)
            log.info("an offer of %s was refused: %s", session.name, type(error).__name__)
            raise HTTPException(400, "this offer cannot be answered") from None
        self._tasks[peer] = asyncio.create_task(self._watch(peer, session))
        return str(peer.localDescription.sdp)

    async def _watch(self, peer: Any, session: Session) -> None:
        """Until the connection or the session is over, or it never came about."""
        began = time.monotonic()
        try:
            while peer.connectionState not in ("failed", "closed", "disconnected"):
                await asyncio.sleep(1.0)
                if self.context.accounts.session_of(session.key) is None:
                    return
                if peer.connectionState != "connected" and time.monotonic() - began > 15:
                    return
        finally:
            await self._end(peer, session.name)
            self._tasks.pop(peer, None)

    async def _end(self, peer: Any, name: str) -> None:
        self._of[name] -= 1
        if not self._of[name]:
            del self._of[name]
        with contextlib.suppress(Exception):
            await peer.close()

    async def stop(self) -> None:
        """End all."""
        for task in list(self._tasks.values()):
            task.cancel()
        await asyncio.gather(*self._tasks.values(), return_exceptions=True)
        self._pool.close()

    def counts(self) -> dict[str, float]:
        """For /metrics."""
        return {"peers": self._of.total()}


def believed(sdp: str, address: str) -> str:
    """An offer whose candidates are at the address from which it came: browsers hide theirs behind names that only multicast
    resolves, and a stranger could name anybody's."""
    lines = []
    for line in sdp.splitlines():
        if line.startswith("a=candidate:"):
            parts = line.split()
            usable = len(parts) >= 8 and parts[2].lower() == "udp" and parts[5].isdigit() and 1024 <= int(parts[5]) < 65536
            if not usable or parts[7] != "host":
                continue
            line = " ".join([*parts[:4], address, *parts[5:8]])
        elif line.startswith("c=IN"):
            line = "c=IN IP4 0.0.0.0"
        lines.append(line)
    return "\r\n".join(lines) + "\r\n"


@router.post("/webrtc")
async def webrtc(request: Request, who: Anybody, body: Offer) -> dict[str, Any]:
    """A stream of pictures."""
    peers: Peers = request.app.state.peers
    assert context_of(request) is peers.context
    return {"type": "answer", "sdp": await peers.answer(who, body, address_of(request)), "iceServers": []}
