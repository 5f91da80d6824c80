"""`tutelage robot` as a program: what it says, with which status it ends, and that nothing keeps it from holding."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from remote.field import MAIN, Field, drive, said
from sgc.fleets import eventually

from tutelage.errors import ConfigError
from tutelage.remote.fleet import RemoteFleet
from tutelage.remote.folders import claim
from tutelage.remote.telling import WAITING, Teller

STILL = np.zeros((3, 2), np.float32)


def test_a_folder_is_for_one_program(field: Field, fleet: RemoteFleet) -> None:
    second = field.start("-c", MAIN, "robot", field.made.robots[0], "--env", "point:Point", wait=False, POINT_LOG="again")
    assert second.wait(20) == 2
    assert f"{field.made.robots[0]} is in use by a robot (process {field.robots[1].pid}); end that first" in said(second)
    status = field.start("-c", MAIN, "fleet", "status", field.server, wait=False)
    assert status.wait(20) == 2
    assert f"is in use by a server (process {os.getpid()})" in said(status)
    assert said(second).count("\n") == said(status).count("\n") == 1
    with pytest.raises(ConfigError, match="is in use by a server"):
        RemoteFleet.connect(field.server)
    drive(lambda: fleet.step(STILL), lambda: fleet.step(STILL)[-1]["online"].all())


def test_a_claim_ends_with_its_program(tmp_path: Path) -> None:
    code = f"""import time
from pathlib import Path
from tutelage.remote.folders import claim
with claim(Path({str(tmp_path)!r}), "x"):
    print(flush=True)
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as program:
        assert program.stdout is not None
        program.stdout.readline()
        with pytest.raises(ConfigError), claim(tmp_path, "y"):
            pass
        program.kill()
    with claim(tmp_path, "y"):
        pass


def test_a_terminal_that_takes_nothing_does_not_keep_a_robot_from_holding_or_ending(
    field: Field, fleet: RemoteFleet
) -> None:
    """As when it was paused, or when the connection to it hangs."""
    field.kill(1)
    reading, writing = os.pipe()
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, 4096)
    os.set_blocking(writing, False)
    while True:
        try:
            os.write(writing, b"x" * 64)
        except BlockingIOError:
            break
    os.set_blocking(writing, True)
    settings = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "POINT_LOG": str(field.log(1))}
    command = [sys.executable, "-c", MAIN, "robot", str(field.made.robots[0]), "--env", "remote.point:Point", "--hz", "20"]
    robot = subprocess.Popen(command, stdout=writing, stderr=writing, env=settings)
    try:
        began = time.monotonic()
        drive(lambda: fleet.step(STILL), lambda: field.moves(1, began), 20.0)
        silent = time.monotonic()
        eventually(lambda: field.notes(1, silent, "hold"), 2.0)
        robot.send_signal(signal.SIGTERM)
        assert robot.wait(10) == 0
    finally:
        robot.kill()
        robot.wait()
        os.close(reading)
        os.close(writing)


def test_a_driver_that_never_returns_is_stopped_and_left_behind_when_the_program_shall_end(
    field: Field, fleet: RemoteFleet
) -> None:
    slow = field.log(2).with_suffix(".slow")
    slow.write_text("600")
    robot, began = field.robots[2], time.monotonic()
    try:
        drive(lambda: fleet.step(STILL), lambda: field.moves(2, began))
        robot.send_signal(signal.SIGINT)
        assert robot.wait(20) == 3
    finally:
        slow.unlink()
        field.kill(2)
    assert field.notes(2)[-1].what == "stop"
    assert "the driver has not returned for 5 s; it was told to stop, and the program ends" in said(robot)


def test_lines_that_nobody_reads_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[bytes] = []
    monkeypatch.setattr("tutelage.remote.telling.os.write", lambda to, line: written.append(line) or len(line))
    teller = Teller()
    teller.say("one")
    teller.say("two", error=True)
    teller.close()
    assert written == [b"one\n", b"two\n"]
    ended = Teller()
    ended.close()
    began = time.monotonic()
    for _ in range(2 * WAITING):
        ended.say("nobody")
    assert time.monotonic() - began < 0.5


@pytest.mark.parametrize("what", ["__init__", "reset", "get_observation"])
def test_a_driver_that_cannot_begin_is_one_line_and_status_3(field: Field, tmp_path: Path, what: str) -> None:
    if 1 in field.robots and field.robots[1].poll() is None:
        field.kill(1)
    body = f"class Broken(Point):\n    def {what}(self, *given):\n        raise OSError('no /dev/arm')\n"
    (field.folder / "broken.py").write_text(f"from point import Point\n{body}")
    robot = field.start(
        "-c", MAIN, "robot", field.made.robots[0], "--env", "broken:Broken", wait=False, POINT_LOG=str(tmp_path / "log")
    )
    assert robot.wait(20) == 3
    assert said(robot).startswith("tutelage: the driver ")
    assert said(robot).endswith(": OSError: no /dev/arm (broken.py:4)\n")
    assert said(robot).count("\n") == 1
