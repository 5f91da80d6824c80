"""A robot's cameras may give anything at any time; what is a picture is sent."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sgc.fleets import eventually

from tutelage.remote import jpeg
from tutelage.remote.eyes import Eyes
from tutelage.remote.wire import unpack_picture

PICTURE = np.zeros((48, 64, 3), np.uint8)


class Camera:
    """Gives what it is told to."""

    gives: Any = PICTURE

    def __call__(self) -> Any:
        if isinstance(self.gives, Exception):
            raise self.gives
        return self.gives


@pytest.mark.parametrize("threaded", [False, True])
@pytest.mark.parametrize(
    "bad", [None, [[1]], "text", PICTURE[0], PICTURE.astype(np.float32), OSError("unplugged"), np.zeros((0, 4, 3), np.uint8)]
)
def test_a_camera_that_gives_no_picture_for_a_while_is_waited_for(
    bad: Any, threaded: bool, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("cv2")
    camera, sent = Camera(), []
    publisher: Any = SimpleNamespace(send=sent.append)
    eyes = Eyes(1, {"front": camera}, {"front": publisher}, hz=100.0, quality=80, threaded=threaded)

    def looks() -> int:
        """Pictures that come within 0.2 s."""
        before = len(sent)
        for _ in range(20):
            eyes.look(1, time.monotonic())
            time.sleep(0.01)
        return len(sent) - before

    try:
        eventually(looks)
        camera.gives = bad
        eventually(lambda: not looks())
        camera.gives = PICTURE
        eventually(looks)
        assert unpack_picture(sent[-1]).width == 64
    finally:
        eyes.close()
    assert "Traceback" not in caplog.text


def test_a_picture_that_no_server_would_take_is_not_sent_and_says_so() -> None:
    pytest.importorskip("cv2")
    noise = np.random.default_rng(0).integers(0, 256, (2400, 2400, 3)).astype(np.uint8)
    with pytest.raises(
        ValueError, match=r"MiB are too much for a picture, which has at most 4 MiB: lower its size or --quality"
    ):
        jpeg.encode(noise, 100)
    assert jpeg.encode(noise, 10)


def test_the_sizes_that_are_told_are_those_that_are_sent() -> None:
    pytest.importorskip("cv2")
    for width, height in ((16, 16), (17, 31), (320, 240), (4096, 16)):
        assert jpeg.decode(jpeg.encode(np.zeros((height, width, 3), np.uint8))).shape == (height, width, 3)


def test_eyes_end_at_once() -> None:
    began = time.monotonic()
    Eyes(1, {"front": Camera()}, {"front": SimpleNamespace(send=id)}, hz=1.0, quality=80, threaded=True).close()  # type: ignore[dict-item]
    assert time.monotonic() - began < 1.0
