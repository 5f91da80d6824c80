"""A robot's cameras: pictures of those that somebody watches, compressed and sent on a thread of their own; newest wins."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from tutelage.remote import jpeg
from tutelage.remote.messages import Picture
from tutelage.remote.simulated import Grab
from tutelage.remote.telling import told
from tutelage.remote.wire import pack_picture
from tutelage.sgc.publisher import Publisher

log = logging.getLogger(__name__)


class Eyes:
    """Made and ended by the robot.

    Attributes:
        names: of the cameras that work, in the order of the description.
        sent, failed: pictures.
    """

    def __init__(
        self, boot: int, cameras: Mapping[str, Grab], publishers: Mapping[str, Publisher],
        *, hz: float, quality: int, threaded: bool,
    ) -> None:  # fmt: skip
        """
        Args:
            cameras: what takes a picture, by name.
            publishers: where they go; cameras without one are left out.
            hz: pictures of a camera in a second, at most.
            quality: of JPEG, 1 to 100.
            threaded: take the pictures on the thread of this, too; else `look` takes them, on the caller's.
        """
        self.names = tuple(name for name in cameras if name in publishers)
        self.sent = self.failed = 0
        self._boot, self._cameras, self._publishers = boot, cameras, publishers
        self._pause, self._quality, self._threaded = 1.0 / hz, quality, threaded
        self._due = dict.fromkeys(self.names, 0.0)
        self._news = threading.Condition()
        self._taken: dict[str, NDArray[Any]] = {}
        self._watch, self._number, self._closed = 0, 0, False
        self._thread = threading.Thread(target=self._work, name="robot-eyes", daemon=True)
        if self.names:
            self._thread.start()

    def look(self, watch: int, now: float) -> None:
        """Take pictures of the cameras that are watched (a bit each) and due."""
        if not self.names:
            return
        if self._threaded:
            if watch != self._watch:
                with self._news:
                    self._watch = watch
                    self._news.notify()
            return
        taken = {name: self._take(name) for name in self._wanted(watch, now)}
        if taken:
            with self._news:
                self._taken |= {name: picture for name, picture in taken.items() if picture is not None}
                self._news.notify()

    def close(self) -> None:
        """Stop."""
        with self._news:
            self._closed = True
            self._news.notify()
        if self._thread.is_alive():
            self._thread.join(2.0)

    def _wanted(self, watch: int, now: float) -> list[str]:
        wanted = [name for k, name in enumerate(self.names) if watch >> k & 1 and now >= self._due[name]]
        for name in wanted:
            # What is asked for at each of a robot's timesteps must not fall into every second one by a hair.
            self._due[name] = max(self._due[name] + self._pause, now + 0.5 * self._pause)
        return wanted

    def _take(self, name: str) -> NDArray[Any] | None:
        try:
            return self._cameras[name]()
        except Exception as error:
            self._missed(name, error)
            return None

    def _work(self) -> None:
        while True:
            with self._news:
                if not self._taken:
                    self._news.wait(self._pause if self._threaded and self._watch else None)
                if self._closed:
                    return
                taken, self._taken, watch = self._taken, {}, self._watch
            if self._threaded:
                grabbed = {name: self._take(name) for name in self._wanted(watch, time.monotonic())}
                taken = {name: picture for name, picture in grabbed.items() if picture is not None}
            for name, picture in taken.items():
                self._send(name, picture)

    def _send(self, name: str, picture: NDArray[Any]) -> None:
        try:
            self._number += 1
            compressed = jpeg.encode(picture, self._quality)
            height, width = picture.shape[:2]
            message = Picture(self._boot, self._number, self.names.index(name), width, height, compressed)
            self._publishers[name].send(pack_picture(message))
            self.sent += 1
        except Exception as error:  # what a camera gives may be anything, and the next one may be a picture
            self._missed(name, error)

    def _missed(self, name: str, error: Exception) -> None:
        self.failed += 1
        if self.failed in (1, 10, 100):
            log.warning("camera %s gave no picture: %s", name, told(error))
