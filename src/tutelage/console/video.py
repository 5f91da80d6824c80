"""The socket /api/video: JPEG pictures, the newest ones only.

Each (robot, camera, size) is drawn and encoded once for all who watch it, as often as the fastest of them wants. A watcher
gets a picture of a stream when their last but one of it has arrived: on a slow link the rate falls, the delay does not grow.
"""

from __future__ import annotations

import asyncio
import contextlib
import struct
import time
from collections import Counter
from dataclasses import dataclass, field

from starlette.websockets import WebSocket

from tutelage.console import messages
from tutelage.console.accounts import Session
from tutelage.console.context import Context, Pool, log
from tutelage.console.pictures import decoded, fitted, jpeg, size_of
from tutelage.console.sockets import Socket, error
from tutelage.errors import TutelageError

HEADER = struct.Struct("<IHHHHId")
"""robot, camera, width, height, 0, sequence, capture time (seconds since 1970)."""
UNACKNOWLEDGED = 2
STREAMS_MAX = 200
Key = tuple[int, int, int, int]
"""robot, camera, width, height."""


@dataclass(frozen=True)
class Picture:
    """An encoded picture. time: when it was taken."""

    time: float
    width: int
    height: int
    content: bytes


@dataclass
class Slot:
    """One stream of one watcher. due: not before (monotonic s); flying: sequences on the way."""

    fps: float
    newest: Picture | None = None
    due: float = 0.0
    flying: set[int] = field(default_factory=set)


class Video:
    """All streams that somebody watches."""

    def __init__(self, context: Context) -> None:
        self.context = context
        self.pool = Pool("video", 2, 4 * STREAMS_MAX)
        self._watchers: dict[Key, set[VideoSocket]] = {}
        self._tasks: dict[Key, asyncio.Task[None]] = {}
        self._encoded = self._sent = 0

    def counts(self) -> dict[str, float]:
        """For /metrics."""
        return {"streams": len(self._watchers), "encoded_total": self._encoded, "sent_total": self._sent}

    def sent(self) -> None:
        """A picture went out."""
        self._sent += 1

    def watch(self, watcher: VideoSocket, keys: set[Key]) -> bool:
        """From now on this watcher watches these; False where there are too many streams already."""
        if len(self._watchers.keys() | keys) > STREAMS_MAX:
            return False
        for key, watchers in list(self._watchers.items()):
            if key not in keys:
                watchers.discard(watcher)
            if not watchers:
                del self._watchers[key]
        for key in keys:
            self._watchers.setdefault(key, set()).add(watcher)
            if key not in self._tasks:
                self._tasks[key] = asyncio.create_task(self._produce(key))
        return True

    async def stop(self) -> None:
        """End."""
        for task in self._tasks.values():
            task.cancel()
        await asyncio.gather(*self._tasks.values(), return_exceptions=True)
        self.pool.close()

    async def _produce(self, key: Key) -> None:
        last = -1.0
        try:
            while watchers := self._watchers.get(key):
                began = time.monotonic()
                fps = max(watcher.slots[key].fps for watcher in watchers)
                picture = await self.pool.run(self._picture, key, last)
                if picture:
                    last, self._encoded = picture.time, self._encoded + 1
                    for watcher in list(self._watchers.get(key, ())):
                        watcher.offer(key, picture)
                await asyncio.sleep(max(0.002, began + 1 / fps - time.monotonic()))
        except Exception as problem:  # those who watch must hear of it, whatever it is
            if not isinstance(problem, TutelageError):
                log.exception("the stream %s failed", key)
                problem = TutelageError("an error of the server; its log says more")
            for watcher in self._watchers.pop(key, set()):
                watcher.refuse("no_picture", f"robot {key[0]}, camera {key[1]}: {problem}")
        finally:
            self._tasks.pop(key, None)
            if key in self._watchers:  # somebody came while it ended
                self._tasks[key] = asyncio.create_task(self._produce(key))

    def _picture(self, key: Key, last: float) -> Picture | None:
        robot, camera, width, height = key
        sent = self.context.supervision.jpeg(robot, camera)
        if sent is not None:
            return _passed_on(*sent, last, width, height)
        frame = self.context.supervision.frame(robot, camera, width, height)
        if frame is None or frame.time == last:
            return None
        rgb = fitted(frame.rgb, width, height)
        return Picture(frame.time, rgb.shape[1], rgb.shape[0], jpeg(rgb))


def _passed_on(time_: float, content: bytes, last: float, width: int, height: int) -> Picture | None:
    """The JPEG of a robot: as it came, unless it is much larger than what is asked for. None: it is not a new one.

    Raises:
        TutelageError: it is no JPEG.
    """
    if time_ == last:
        return None
    shape = size_of(content)
    if shape[0] > 1.5 * width or shape[1] > 1.5 * height:
        rgb = fitted(decoded(content), width, height)
        return Picture(time_, rgb.shape[1], rgb.shape[0], jpeg(rgb))
    return Picture(time_, *shape, content)


class VideoSocket(Socket):
    """One page that watches."""

    open_now: Counter[str] = Counter()
    silent = 30.0  # who watches nothing has nothing to say
    flood = 2000.0, 4000  # every picture is acknowledged

    def __init__(self, websocket: WebSocket, video: Video, session: Session) -> None:
        super().__init__(websocket, video.context, session)
        self.video = video
        self.slots: dict[Key, Slot] = {}
        self._flying: dict[int, Key] = {}
        self._texts: list[str] = []
        self._sequence = 0

    def offer(self, key: Key, picture: Picture) -> None:
        """A new picture of a stream."""
        slot = self.slots.get(key)
        if slot:
            slot.newest = picture
            self.wake.set()

    def refuse(self, code: str, why: str, ref: int | str | None = None) -> None:
        if len(self._texts) < 50:
            self._texts.append(error(code, why, ref))
            self.wake.set()

    async def received(self, message: str) -> None:
        said = messages.parse_video(message)
        if isinstance(said, messages.Got):
            key = self._flying.pop(said.sequence, None)
            if key in self.slots:
                self.slots[key].flying.discard(said.sequence)
                self.wake.set()
        elif isinstance(said, messages.Watch):
            self._watch(said)

    def _watch(self, said: messages.Watch) -> None:
        description = self.context.supervision.description
        slots: dict[Key, Slot] = {}
        for stream in said.streams:
            if stream.robot >= len(description.robots) or stream.camera >= max(1, len(description.cameras)):
                self.refuse("unknown_robot", f"no robot {stream.robot} with camera {stream.camera}", said.ref)
                continue
            key = stream.robot, stream.camera, stream.width, stream.height
            slots[key] = self.slots.get(key) or Slot(stream.fps)
            slots[key].fps = stream.fps
        before, self.slots = self.slots, slots
        if not self.video.watch(self, set(slots)):
            self.slots = before
            self.refuse("too_many", f"more than {STREAMS_MAX} streams are watched", said.ref)

    async def send_what_waits(self) -> float | None:
        while self._texts:
            await self.websocket.send_text(self._texts.pop(0))
        wait: float | None = None
        for key, slot in list(self.slots.items()):
            picture, now = slot.newest, time.monotonic()
            if picture is None or len(slot.flying) >= UNACKNOWLEDGED:
                continue
            if now < slot.due:
                wait = min(wait or 1.0, slot.due - now)
                continue
            slot.newest, slot.due = None, max(slot.due + 1 / slot.fps, now + 0.5 / slot.fps)
            sequence, self._sequence = self._sequence, (self._sequence + 1) % 2**32
            slot.flying.add(sequence)
            self._flying[sequence] = key
            header = HEADER.pack(key[0], key[1], picture.width, picture.height, 0, sequence, picture.time)
            await self.websocket.send_bytes(header + picture.content)
            self.video.sent()
        return wait

    async def finish(self) -> None:
        self.slots = {}
        with contextlib.suppress(RuntimeError):
            self.video.watch(self, set())
