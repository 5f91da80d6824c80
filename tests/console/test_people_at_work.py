"""The whole server: people at sockets, the loop, the record."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from consoles import Running, Socket
from floor import config

from tutelage.console.supervision import Supervision


@pytest.fixture(scope="module")
def floor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """Four points on a line, two seats, 20 Hz."""
    out = tmp_path_factory.mktemp("floor")
    server = Running(out, lambda audit: Supervision.open(config(out, hz=20.0), audit))
    yield server
    server.close()


def take(socket: Socket, robot: int) -> str:
    """Take a robot that nobody has; the lease."""
    deadline = time.monotonic() + 10
    while True:
        socket.say("take", robot=robot, ref=f"take-{robot}")
        with contextlib.suppress(AssertionError):
            return str(socket.hear("lease", 0.5, robot=robot)["id"])
        assert time.monotonic() < deadline
        socket.say("ping")


def test_of_two_people_who_grab_one_robot_one_has_it(floor: Running) -> None:
    with floor.socket("ana") as ana, floor.socket("operator") as other:
        ana.hear("hello")
        other.hear("hello")
        both = threading.Barrier(2)

        def grab(socket: Socket) -> None:
            both.wait()
            socket.say("take", robot=0, ref=1)

        threads = [threading.Thread(target=grab, args=(socket,)) for socket in (ana, other)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        answers = []
        for socket in (ana, other):
            while True:
                message = socket.hear_any(("ack", "error"))
                if message.get("ref") == 1:
                    answers.append(message)
                    break
        assert sorted(answer["type"] for answer in answers) == ["ack", "error"]
        assert next(answer for answer in answers if answer["type"] == "error")["code"] == "taken"
        (winner,) = [socket for socket, answer in zip((ana, other), answers, strict=True) if answer["type"] == "ack"]
        lease = winner.heard("lease", robot=0)["id"]
        state = winner.hear("state")
        while "0" not in state["leases"]:
            state = winner.hear("state")
        assert state["leases"]["0"]["id"] == lease
        winner.say("give_back", robot=0)
        winner.hear("lease_end", robot=0)


def test_what_a_person_does_moves_the_robot_and_is_recorded(floor: Running) -> None:
    with floor.socket("ana") as ana:
        ana.hear("hello")
        lease = take(ana, 1)
        for seq in range(1, 25):
            ana.say("command", robot=1, lease=lease, seq=seq, action=[0.25])
            time.sleep(0.05)
        ana.say("give_back", robot=1, ref="done")
        ana.hear("lease_end", robot=1)
    samples = [sample for sample in floor.audit.samples() if sample.fields.get("lease") == lease]
    assert len(samples) >= 10
    assert {sample.who for sample in samples} == {"ana"}
    for sample in samples:
        np.testing.assert_allclose(sample.arrays["wanted"], [0.25])
    assert floor.audit.verify().ok


def test_a_tab_that_is_closed_leaves_a_robot_that_holds_and_what_was_recorded(floor: Running) -> None:
    with floor.socket("operator") as watching:
        watching.hear("hello")
        cookie = floor.cookie("ana")
        with contextlib.ExitStack() as stack:
            ana = stack.enter_context(floor.socket("ana", cookie=cookie))
            ana.hear("hello")
            lease = take(ana, 2)
            for seq in range(1, 15):
                ana.say("command", robot=2, lease=lease, seq=seq, action=[0.1])
                time.sleep(0.05)
            ana.connection.socket.close()  # the laptop is gone: no word of goodbye
        gone = time.monotonic()
        while True:
            state = watching.hear("state")
            watching.say("ping")
            if state["held"][2] or "2" not in state["leases"]:
                break
        assert time.monotonic() - gone < 1.0
        while "2" in watching.hear("state")["leases"]:
            watching.say("ping")
            assert time.monotonic() - gone < 10
    assert len([sample for sample in floor.audit.samples() if sample.fields.get("lease") == lease]) >= 5


def test_a_page_that_is_loaded_again_finds_its_robot(floor: Running) -> None:
    cookie = floor.cookie("ana")
    with floor.socket("ana", cookie=cookie) as ana:
        ana.hear("hello")
        lease = take(ana, 3)
    with floor.socket("ana", cookie=cookie) as ana:
        assert ana.hear("lease", robot=3)["id"] == lease
        ana.say("command", robot=3, lease=lease, seq=1, action=[0.1])
        ana.say("give_back", robot=3)
        ana.hear("lease_end", robot=3)


def test_an_emergency_stop_stops_all_at_once(floor: Running) -> None:
    with floor.socket("ana") as ana:
        ana.hear("hello")
        began = time.monotonic()
        ana.say("estop", robot=None, ref=1)
        while not all(ana.hear("state")["stopped"]):
            pass
        assert time.monotonic() - began < 0.6
        ana.say("estop_clear", robot=None, ref=2)
        ana.hear("ack", ref=2)
        while any(ana.hear("state")["stopped"]):
            ana.say("ping")
    floor.audit.flush()
    assert [row.who for row in floor.audit.rows(kind="estop")][:1] == ["ana"]
