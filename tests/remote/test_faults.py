"""What can go wrong between robots and server: killed, frozen, flooded, forged, set wrong. Each with processes of their own."""

from __future__ import annotations

import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from remote.field import Field, drive, said
from sgc.fleets import eventually

from tutelage.fleet.modes import Mode
from tutelage.remote import topics
from tutelage.remote.fleet import RemoteFleet
from tutelage.remote.messages import Command, Order
from tutelage.remote.wire import pack_command
from tutelage.sgc.authority import Authority
from tutelage.sgc.errors import NotAllowed
from tutelage.sgc.home import Home
from tutelage.sgc.node import Node
from tutelage.sgc.transport.config import NetworkConfig

STILL = np.zeros((3, 2), np.float32)
WATCHDOG, SLACK = 0.5, 0.15  # seconds; the second for a machine that is busy


def held_within(field: Field, number: int, since: float) -> float:
    """Seconds from then until the robot's first order to hold after which it got no action."""
    eventually(lambda: time.monotonic() > since + 2 * WATCHDOG)
    last = max((note.time for note in field.notes(number, 0.0, "act")), default=since)
    holds = [note.time for note in field.notes(number, last, "hold", "stop")]
    assert holds, "it does not hold"
    return holds[0] - since


def all_move(fleet: RemoteFleet, still: np.ndarray = STILL) -> None:
    """Wait until all robots are in reach and none of them is held."""

    def moving() -> bool:
        info = fleet.step(still)[-1]
        return bool(info["online"].all() and not info["held"].any())

    drive(lambda: None, moving, 15.0)


def test_a_robot_killed_and_started_again_begins_a_new_episode(field: Field, fleet: RemoteFleet) -> None:
    all_move(fleet)
    field.kill(1)
    killed = time.monotonic()
    online = []
    while time.monotonic() < killed + 1.0:
        obs, *_, info = fleet.step(np.array([[1, 1], [0, 0], [0, 0]], np.float32))
        online.append(bool(info["online"][0]))
    assert not any(online[-6:])
    assert fleet.status()[0]["state"] == "gone"
    assert np.isfinite(obs).all()  # the last one is still there
    field.robots[1] = field.robot(1, "--hz", 20, wait=False)
    all_move(fleet)
    assert fleet.status()[0]["starts"] == 2
    obs, *_, info = fleet.step(STILL)
    assert obs[0] == pytest.approx([0, 0], abs=0.3)
    assert info["elapsed"][0] < 40


def test_a_restart_that_nobody_noticed_is_still_seen_as_one(field: Field, fleet: RemoteFleet) -> None:
    """A server that is busy for longer than a robot takes to restart must not take two episodes for one."""
    all_move(fleet)
    field.kill(2)
    field.robots[2] = field.robot(2, "--hz", 20)
    eventually(lambda: fleet.status()[1]["starts"] == 2 and fleet.status()[1]["state"] == "online")
    assert not fleet.step(STILL)[-1]["online"][1]
    assert fleet.step(STILL)[-1]["online"][1]


def test_a_frozen_robot_drops_what_came_meanwhile(field: Field, fleet: RemoteFleet) -> None:
    all_move(fleet)
    robot = field.robots[3]
    robot.send_signal(signal.SIGSTOP)
    try:
        frozen = time.monotonic()
        while time.monotonic() < frozen + 1.0:
            info = fleet.step(np.array([[0, 0], [0, 0], [0.7, 0.7]], np.float32))[-1]
        assert info["online"].tolist() == [True, True, False]
    finally:
        robot.send_signal(signal.SIGCONT)
    woken = time.monotonic()
    eventually(lambda: field.notes(3, woken))
    assert field.notes(3, woken)[0].what == "hold"  # before anything else
    all_move(fleet)
    assert ("0.7", "0.7") not in {note.words for note in field.notes(3, woken, "act")}
    assert fleet.status()[2]["starts"] == 1


def test_robots_hold_when_the_server_is_killed_and_follow_the_next_one(field: Field, fleet: RemoteFleet) -> None:
    fleet.close()
    server = field.start(Path(__file__).with_name("server.py"), field.server)
    began = time.monotonic()
    eventually(lambda: all(field.moves(number, began) for number in (1, 2, 3)))
    server.kill()
    killed = time.monotonic()
    for number in (1, 2, 3):
        assert held_within(field, number, killed) < WATCHDOG + SLACK
    again = time.monotonic()
    field.start(Path(__file__).with_name("server.py"), field.server)
    eventually(lambda: all(field.moves(number, again) for number in (1, 2, 3)))
    assert time.monotonic() - again < 5.0
    assert not field.notes(1, killed, "reset")  # robots go on with the episode that they were in
    field.running[-1].kill()


def test_robots_hold_when_the_router_is_killed_and_come_back_with_it(field: Field, fleet: RemoteFleet) -> None:
    all_move(fleet)
    field.running[0].kill()
    field.running[0].wait()
    killed = time.monotonic()
    while time.monotonic() < killed + 1.0:
        info = fleet.step(STILL)[-1]
    assert not info["online"].any()
    for number in (1, 2, 3):
        assert held_within(field, number, killed) < WATCHDOG + SLACK
    field.running[0] = field.router()
    all_move(fleet)


def test_a_server_that_thinks_for_too_long_finds_its_commands_refused(field: Field, fleet: RemoteFleet) -> None:
    """The robot judges by the observation that a command answers, so a slow server is as late as a slow network."""
    all_move(fleet)
    before = fleet.status()[0]["stale"]
    old = fleet._slots[0].delivered
    assert old is not None
    time.sleep(2 * WATCHDOG)
    began = time.monotonic()
    for k in range(5):
        late = Command(fleet.server, 10_000_000 + k, old.boot, old.number, Order.ACT, 0, 0.05, np.ones(2, np.float32))
        fleet._commands[0].send(pack_command(late))
        time.sleep(0.05)
    assert not field.moves(1, began)
    eventually(lambda: fleet.status()[0]["stale"] > before)
    fleet._number = 20_000_000  # whoever counts on is heard again
    all_move(fleet)


def test_messages_that_are_damaged_or_for_another_start_are_counted_and_do_nothing(field: Field, fleet: RemoteFleet) -> None:
    all_move(fleet)
    began = time.monotonic()
    other = Command(fleet.server, 30_000_000, 12345, 1, Order.ACT, 0, 0.05, np.ones(2, np.float32))
    for bad in (b"", b"noise" * 100, pack_command(other), pack_command(other)[:-3]):
        fleet._commands[1].send(bad)
        fleet._tending.lanes[1].send(bad)
        fleet.step(STILL)
    assert not field.notes(2, began, "stop")
    eventually(lambda: fleet.status()[1]["refused_there"] >= 4)
    all_move(fleet)


def test_who_is_not_the_server_cannot_command_and_who_is_not_the_robot_cannot_observe(
    field: Field, fleet: RemoteFleet
) -> None:
    home = Home.create(field.folder / "thief", "thief")  # a member of the fleet, with no part in these topics
    authority = Authority.open(field.made.authority)
    home.accept(authority.issue(home.request()))
    NetworkConfig.load(field.server).save(home.path)
    with Node.open(home) as thief:
        for what in (topics.COMMAND, topics.STOP, topics.OBSERVATION):
            with pytest.raises(NotAllowed):
                thief.publisher(topics.alias("robot-1", what))
        with pytest.raises(NotAllowed):
            thief.request(topics.alias("robot-1", topics.SERVICE), b"")
    # What is no packet of the robot's is refused where it arrives, should a router carry it.
    before = sum(fleet.refused().values())
    for forged in (b"", b"x" * 200, bytes(300)):
        fleet._subscriptions[0]._arrive(forged)
    eventually(lambda: sum(fleet.refused().values()) >= before + 3)
    all_move(fleet)


def test_the_emergency_stop_acts_while_the_command_lane_and_the_network_are_flooded(
    field: Field, fleet: RemoteFleet
) -> None:
    all_move(fleet)
    ending = threading.Event()
    command = Command(fleet.server, 1 << 40, 1, 1, Order.ACT, 0, 0.05, np.zeros(2, np.float32))
    junk = pack_command(command) + bytes(1 << 20)  # a megabyte each, and the lane is for messages of eighty bytes

    def flood() -> None:
        while not ending.is_set():
            fleet._commands[2].send(junk)

    threads = [threading.Thread(target=flood) for _ in range(2)]
    for thread in threads:
        thread.start()
    try:
        time.sleep(1.0)
        began = time.monotonic()
        fleet.stop(2)
        eventually(lambda: field.notes(3, began, "stop"), 5.0)
        took = field.notes(3, began, "stop")[0].time - began
    finally:
        ending.set()
        for thread in threads:
            thread.join()
    refused = fleet.status()[2]["refused_there"]
    print(f"stopped after {1000 * took:.0f} ms in a flood of {fleet._commands[2].bytes >> 20} MB; {refused} refused")
    assert took < 0.5
    assert not field.moves(3, began + took + 0.1)
    assert fleet._commands[2].bytes > 20 << 20
    eventually(lambda: fleet.status()[2]["refused_there"] > 10)
    fleet.clear()
    all_move(fleet)


def test_a_robot_that_does_not_fit_is_left_out_and_the_others_go_on(field: Field, fleet: RemoteFleet) -> None:
    all_move(fleet)
    field.kill(2)
    other = field.robot(2, "--hz", 20, env="point:Plane")
    drive(lambda: fleet.step(STILL), lambda: fleet.status()[1]["state"] == "misfit")
    info = fleet.step(STILL)[-1]
    assert info["online"].tolist() == [True, False, True]
    says = fleet.status()[1]["says"]
    assert "observes (5,) float32, and the fleet (2,) float32" in says
    assert says.endswith(f"if the fleet is another one now, remove {field.server / 'fleet.json'}")
    other.kill()
    other.wait()


@pytest.mark.parametrize("skew", [-4.0, 4.0])
def test_a_robot_whose_clock_is_wrong_by_seconds_works_like_any_other(field: Field, fleet: RemoteFleet, skew: float) -> None:
    field.kill(1)
    field.robots[1] = field.robot(1, "--hz", 20, skew=skew)
    all_move(fleet)
    began = time.monotonic()
    for _ in range(20):
        assert fleet.step(STILL)[-1]["online"].all()
    assert len(field.notes(1, began, "act")) >= 18
    assert fleet.status()[0]["stale"] == 0
    fleet.stop(0)
    eventually(lambda: field.notes(1, began, "stop"), 1.0)
    field.kill(1)


def test_a_robot_whose_clock_is_wrong_by_a_minute_is_refused_and_the_server_knows_why(
    field: Field, fleet: RemoteFleet
) -> None:
    all_move(fleet)
    field.kill(1)
    field.robots[1] = field.robot(1, "--hz", 20, skew=60.0)
    began = time.monotonic()
    drive(lambda: fleet.step(STILL), lambda: fleet.status()[0]["says"], 15.0)
    assert fleet.status()[0]["state"] == "gone"
    assert "is refused (future): its clock and the server's differ; set them (NTP)" in fleet.status()[0]["says"]
    assert fleet.step(STILL)[-1]["online"].tolist() == [False, True, True]
    assert not field.moves(1, began)
    field.kill(1)


def test_the_loop_goes_on_while_robots_come_and_go(field: Field, fleet: RemoteFleet) -> None:
    """The loop is the one of the simulated fleets."""
    from tutelage.fleet.allocation import FleetDAgger
    from tutelage.fleet.loop import Loop
    from tutelage.fleet.priority import parse
    from tutelage.fleet.supervisor import Team

    class Still:
        def act(self, obs: np.ndarray, robots: np.ndarray | None = None) -> np.ndarray:
            return np.zeros((len(obs), 2), np.float32)

    loop = Loop(fleet, Still(), parse("C."), Team([Still()]), FleetDAgger())
    modes = []

    def step() -> None:
        loop.step()
        modes.append(loop.mode.copy())

    drive(step, lambda: len(modes) > 10 and (loop.mode == Mode.AUTONOMOUS).all())
    field.kill(1)
    drive(step, lambda: loop.mode[0] == Mode.OFFLINE)
    assert (loop.mode[1:] == Mode.AUTONOMOUS).all()
    field.robots[1] = field.robot(1, "--hz", 20, wait=False)
    drive(step, lambda: (loop.mode == Mode.AUTONOMOUS).all())


def test_a_driver_that_fails_for_a_moment_is_waited_for_and_one_that_goes_on_failing_ends_the_program(
    field: Field, fleet: RemoteFleet
) -> None:
    all_move(fleet)
    trouble = field.log(3).with_suffix(".fail")
    trouble.touch()
    drive(lambda: fleet.step(STILL), lambda: fleet.status()[2]["state"] == "fault")
    assert not fleet.step(STILL)[-1]["online"][2]
    trouble.unlink()
    all_move(fleet)
    trouble.touch()
    robot = field.robots[3]
    assert robot.wait(10) == 3
    assert "the driver of robot-3 goes on failing: OSError: the sensor is unplugged" in said(robot)
    assert field.notes(3)[-1].what == "hold"
    trouble.unlink()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_told_to_end_a_robot_holds_and_exits_with_0(field: Field, fleet: RemoteFleet, number: signal.Signals) -> None:
    all_move(fleet)
    robot = field.robots[2]
    robot.send_signal(number)
    assert robot.wait(10) == 0, said(robot)
    assert field.notes(2)[-1].what == "hold"
    assert said(robot).endswith("robot-2: ended\n")
