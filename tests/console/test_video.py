"""Pictures: the newest ones, encoded once, no more of them than arrive."""

from __future__ import annotations

import contextlib
import json
import time
from typing import Any

import cv2
import numpy as np
import pytest
from consoles import Running, Socket
from hypothesis import given
from hypothesis import strategies as st

from tutelage.console.pictures import fitted, jpeg, size_of
from tutelage.console.video import HEADER
from tutelage.errors import TutelageError

STREAM = {"robot": 1, "camera": 0, "width": 320, "height": 180, "fps": 20}


def pictures(video: Socket, seconds: float, got: bool = True) -> list[tuple[Any, ...]]:
    """The headers (and JPEG) of what comes in so many seconds."""
    seen: list[tuple[Any, ...]] = []
    deadline = time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0:
        with contextlib.suppress(TimeoutError):
            message = video.connection.recv(left)
            if isinstance(message, bytes):
                header = HEADER.unpack_from(message)
                seen.append((*header, message[HEADER.size :]))
                if got:
                    video.say("got", sequence=header[5])
    return seen


def test_a_watcher_gets_numbered_pictures_of_what_they_watch(running: Running) -> None:
    with running.socket("viewer", "/api/video") as video:
        video.say("watch", streams=[STREAM, STREAM | {"robot": 2, "camera": 1, "width": 160, "height": 90}])
        seen = pictures(video, 1.5)
    assert {(robot, camera, width, height) for robot, camera, width, height, *_ in seen} == {
        (1, 0, 320, 180),
        (2, 1, 160, 90),
    }
    assert [header[5] for header in seen] == list(range(len(seen)))
    times = [header[6] for header in seen if header[0] == 1]
    assert times == sorted(set(times))
    assert 15 <= len(times) <= 32
    robot, *_, content = seen[-1]
    rgb = cv2.cvtColor(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    assert abs(int(rgb[50, 50, 0]) - 40 * robot) < 8


def test_the_rate_is_the_one_that_was_asked_for(running: Running) -> None:
    with running.socket("viewer", "/api/video") as video:
        video.say("watch", streams=[STREAM | {"fps": 5}])
        assert 6 <= len(pictures(video, 2.0)) <= 12


def test_two_pictures_at_most_are_on_the_way_and_then_the_newest_comes(running: Running) -> None:
    with running.socket("viewer", "/api/video") as video:
        video.say("watch", streams=[STREAM])
        first = pictures(video, 1.0, got=False)
        assert len(first) == 2
        video.say("got", sequence=first[0][5])
        (newest,) = pictures(video, 0.6, got=False)
        assert newest[6] > first[1][6] + 0.5


def test_an_empty_list_ends_the_pictures_and_their_making(running: Running) -> None:
    with running.socket("viewer", "/api/video") as video:
        video.say("watch", streams=[STREAM])
        assert pictures(video, 0.5)
        video.say("watch", streams=[])
        pictures(video, 0.3)
        assert not pictures(video, 0.4)
        assert running.numbers()["tutelage_video_streams"] == 0


def test_a_stream_is_encoded_once_for_all_who_watch_it(running: Running) -> None:
    cookie = running.cookie("viewer")
    with contextlib.ExitStack() as stack:
        videos = [stack.enter_context(running.socket("viewer", "/api/video", cookie)) for _ in range(4)]
        for video in videos:
            video.say("watch", streams=[STREAM | {"fps": 10}])
        pictures(videos[0], 0.3)
        before = running.numbers()
        pictures(videos[0], 1.0)
        after = running.numbers()
    assert after["tutelage_video_streams"] == 1
    assert 5 <= after["tutelage_video_encoded_total"] - before["tutelage_video_encoded_total"] <= 14


def test_a_watcher_who_goes_leaves_nothing_behind(running: Running) -> None:
    with running.socket("viewer", "/api/video") as video:
        video.say("watch", streams=[STREAM])
        assert pictures(video, 0.4)
    deadline = time.monotonic() + 3
    while running.numbers()["tutelage_video_streams"]:
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_watcher_who_does_not_read_does_not_slow_the_others(running: Running) -> None:
    running.supervision.shape = (720, 1280)
    large = {"robot": 3, "camera": 0, "width": 1280, "height": 720, "fps": 20}
    cookie = running.cookie("viewer")
    with running.socket("viewer", "/api/video", cookie, max_queue=1) as stuck, running.socket("ana", "/api/video") as video:
        for sequence in range(2000):  # claims to have got what it never read
            stuck.say("got", sequence=sequence)
        stuck.say("watch", streams=[large])
        video.say("watch", streams=[large | {"fps": 10}])
        assert len(pictures(video, 1.5)) >= 8
    running.supervision.shape = (180, 320)


@pytest.mark.parametrize(
    ("streams", "code"),
    [([STREAM | {"robot": 99}], "unknown_robot"), ([STREAM | {"camera": 2}], "unknown_robot"), ([STREAM | {"width": 5}], "malformed"),
     ([STREAM | {"height": 9999}], "malformed"), ([STREAM | {"fps": 0}], "malformed"), ([STREAM] * 31, "malformed"),
     ("all", "malformed")],
)  # fmt: skip
def test_what_cannot_be_watched_is_told(running: Running, streams: Any, code: str) -> None:
    with running.socket("viewer", "/api/video") as video:
        video.say("watch", streams=streams)
        assert json.loads(video.connection.recv(5))["code"] == code


def test_the_number_of_streams_is_limited(running: Running) -> None:
    with contextlib.ExitStack() as stack:
        said = []
        for name in ("viewer", "ana"):
            cookie = running.cookie(name)
            for k in range(4):
                video = stack.enter_context(running.socket(name, "/api/video", cookie))
                base = 100 + 40 * (4 * (name == "ana") + k)
                video.say("watch", streams=[STREAM | {"width": base + i, "fps": 1} for i in range(30)])
                video.say("nothing")
                while isinstance(message := video.connection.recv(5), bytes):
                    pass
                said.append(json.loads(message)["code"])
    assert said == ["malformed"] * 6 + ["too_many"] * 2


def test_pictures_keep_their_shape() -> None:
    rgb = np.zeros((400, 300, 3), dtype=np.uint8)
    assert fitted(rgb, 320, 180).shape == (180, 135, 3)
    assert fitted(rgb, 4000, 4000) is rgb
    assert cv2.imdecode(np.frombuffer(jpeg(rgb), np.uint8), cv2.IMREAD_COLOR).shape == (400, 300, 3)


def test_a_jpeg_from_a_robot_is_passed_on_as_it_came_or_made_smaller(running: Running) -> None:
    rgb = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    running.supervision.sent = jpeg(rgb)
    try:
        with running.socket("viewer", "/api/video") as video:
            video.say("watch", streams=[STREAM, STREAM | {"width": 100, "height": 100}])
            seen = {header[2:4]: header[-1] for header in pictures(video, 0.6)}
        assert seen.keys() == {(320, 240), (100, 75)}
        assert seen[320, 240] == running.supervision.sent
    finally:
        running.supervision.sent = b""


@pytest.mark.parametrize(
    "content", [b"GIF89a" * 10, b"\xff\xd8", b"\xff\xd8\xff\xc0\x00\x00", b"\xff\xd8" + b"\xff\xe0\x00\x00" * 30]
)
def test_what_is_no_jpeg_is_told(running: Running, content: bytes) -> None:
    running.supervision.sent = content
    try:
        with running.socket("viewer", "/api/video") as video:
            video.say("watch", streams=[STREAM])
            assert json.loads(video.connection.recv(5))["code"] == "no_picture"
    finally:
        running.supervision.sent = b""


@given(st.binary(max_size=40) | st.binary(max_size=40).map(lambda tail: b"\xff\xd8\xff" + tail))
def test_any_bytes_have_a_size_or_are_no_jpeg(content: bytes) -> None:
    with contextlib.suppress(TutelageError):
        width, height = size_of(content)
        assert width > 0
        assert height > 0
