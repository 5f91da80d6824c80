"""People and the loop: what each call does to the fleet, and how fast."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from floor import LeaseEnded, LeaseGranted, Offer, Serving, config

from tutelage.console.audit import samples_in
from tutelage.console.states import Denied, Metrics
from tutelage.fleet.modes import Mode


def position(server: Serving, robot: int) -> float:
    return float(server.of.engine.loop.obs[robot, 0])


def drive(server: Serving, lease: Any, action: float | None, seq: int, **rest: Any) -> bool:
    return server.of.command(lease.operator, lease.robot, lease.id, seq, None if action is None else [action], **rest)


class TestDriving:
    def test_a_person_takes_drives_and_gives_back(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            assert server.now.mode[1] == Mode.TELEOPERATED
            begin = server.now.t
            for seq in range(4):
                drive(server, lease, 0.125, seq)
                server.steps(3)
            server.of.give_back("ann", 1)
            ended = server.wait_told(LeaseEnded, operator="ann")
            assert ended.why == "given_back"
            assert 0.1 < ended.seconds < 5
            server.wait(lambda: server.now.mode[1] == Mode.AUTONOMOUS)
        samples = list(samples_in(tmp_path))
        assert len(samples) >= 10
        assert {(s.who, s.robot, s.fields["lease"]) for s in samples} == {("ann", 1, lease.id)}
        assert samples[0].fields["t"] >= begin - 1
        assert [float(s.arrays["wanted"][0]) for s in samples] == [0.125] * len(samples)
        assert set(samples[0].arrays) == {"obs", "proposed", "executed", "wanted"}

    def test_a_robot_whose_person_says_nothing_stands_still(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path, hz=20.0)) as server:
            lease = server.take("ann", 1)
            server.steps(2)
            before = position(server, 1)
            server.steps(5)
            assert position(server, 1) == before
            assert server.now.held[1]
            drive(server, lease, 0.1, 0)
            server.steps(3)
            assert position(server, 1) != before
            assert not server.now.held[1]
            server.wait(lambda: server.now.held[1], 0.6, "no fresh command for half a second: it holds")
            before = position(server, 1)
            server.steps(5)
            assert position(server, 1) == before

    def test_letting_go_of_all_keys_holds_at_once(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            drive(server, lease, 0.5, 0)
            server.steps(2)
            drive(server, lease, None, 1)
            server.steps(1)
            before = position(server, 1)
            server.steps(3)
            assert position(server, 1) == before

    def test_every_command_is_in_the_record(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            drive(server, lease, 0.25, 3)
            drive(server, lease, 0.5, 2)  # too late
            server.of.command("ann", 1, lease.id, 4, None, assist=True)
            for seq in range(5, 9):
                drive(server, lease, None, seq)
            server.audit.flush()
            rows = list(reversed(server.audit.rows(kind="command")))
        said = [json.loads(row.fields) for row in rows]
        assert [row["seq"] for row in said] == [3, 4, 5], "that nothing is pressed is said once"
        assert said[0] == {"lease": lease.id, "seq": 3, "action": [0.25]}
        assert said[1] == {"lease": lease.id, "seq": 4, "assist": True}
        assert {(row.who, row.robot) for row in rows} == {("ann", 1)}

    def test_an_older_command_is_dropped(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            assert drive(server, lease, 0.5, 7)
            assert not drive(server, lease, -0.5, 6)
            assert not drive(server, lease, -0.5, 7)
            assert server.of.engine.people.commands[1].action == pytest.approx([0.5])

    @pytest.mark.parametrize("action", [[0.1, 0.2], [], [float("nan")], [float("inf")], ["1"], "1", [None], [True], [[1.0]]])
    def test_bad_commands_are_refused(self, tmp_path: Path, action: Any) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            with pytest.raises(Denied) as denied:
                server.of.command("ann", 1, lease.id, 0, action)
            assert denied.value.code == "bad_command"

    def test_a_command_beyond_the_bounds_is_clipped(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            drive(server, lease, 100.0, 0)
            assert server.of.engine.people.commands[1].action == pytest.approx([1.0])

    def test_the_expert_acts_while_the_key_is_held(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            for seq in range(10):
                server.of.command("ann", 1, lease.id, seq, None, assist=True)
                server.steps(1)
        for sample in samples_in(tmp_path):
            assert sample.arrays["wanted"] == pytest.approx(np.clip(-5 * sample.arrays["obs"][:1], -1, 1), abs=1e-5)

    def test_pointing_means_nothing_here(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            with pytest.raises(Denied) as denied:
                server.of.command("ann", 1, lease.id, 0, None, push=[0.1, 0.1, 0.2, 0.2])
            assert denied.value.code == "bad_command"

    def test_a_completed_episode_ends_the_lease(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path, hz=100.0)) as server:
            lease = server.take("ann", 1)
            for seq in range(200):
                try:
                    drive(server, lease, 1.0, seq)
                except Denied:
                    break
                server.steps(1)
            assert server.wait_told(LeaseEnded, lease=lease.id).why == "completed"
            server.wait(lambda: server.now.mode[1] == Mode.AUTONOMOUS)


class TestHelping:
    def test_a_robot_that_fell_is_offered_and_reset(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            server.of.join("ann")
            robot = knock_over(server)
            offer = server.wait_told(Offer, operator="ann")
            assert (offer.robot, offer.reason) == (robot, "violated")
            assert server.now.queue[0]["robot"] == robot
            lease = server.of.accept("ann", robot)
            server.steps(5)
            assert server.now.mode[robot] == Mode.SWITCHING, "it waits for the person to say so"
            server.of.reset("ann", robot)
            ended = server.wait_told(LeaseEnded, lease=lease.id)
            assert ended.why == "reset_done"
            server.wait(lambda: server.now.mode[robot] == Mode.AUTONOMOUS)
            row = server.of.operators()[0]
            assert (row["operator"], row["interventions"], row["resets"]) == ("ann", 1, 1)
            assert row["acceptance_time"] > 0
            assert row["human_time"] > 0

    def test_a_robot_that_has_not_fallen_may_be_reset_too(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 2)
            server.of.reset("ann", 2)
            assert server.wait_told(LeaseEnded, lease=lease.id).why == "reset_done"

    def test_a_fall_in_somebodys_hands_ends_the_lease(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            for seq in range(60):
                try:
                    drive(server, lease, -1.0, seq)
                except Denied:
                    break
                server.steps(1)
            assert server.wait_told(LeaseEnded, lease=lease.id).why == "violated"
            assert server.now.mode[1] == Mode.VIOLATED

    def test_a_robot_is_handed_over(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            server.of.join("bob")
            server.of.hand_over("ann", 1, "bob")
            assert server.wait_told(Offer, operator="bob").robot == 1
            drive(server, lease, 0.1, 0)
            new = server.of.accept("bob", 1)
            assert server.wait_told(LeaseEnded, operator="ann").why == "handed_over"
            with pytest.raises(Denied):
                drive(server, lease, 0.1, 1)
            server.steps(2)
            assert drive(server, new, 0.1, 0)
            assert server.now.leases[1]["operator"] == "bob"
            assert server.now.mode[1] == Mode.TELEOPERATED

    def test_two_people_cannot_have_one_robot(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            server.take("ann", 1)
            server.of.join("bob")
            with pytest.raises(Denied) as denied:
                server.of.take("bob", 1)
            assert denied.value.code == "taken"


class TestGone:
    def test_a_person_who_vanishes_leaves_a_robot_that_holds_and_is_offered_again(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path, wait=True)) as server:
            lease = server.take("ann", 1)
            for seq in range(5):
                drive(server, lease, 0.2, seq)
                server.steps(1)
            left = time.monotonic()
            server.of.leave("ann")
            server.wait(lambda: server.now.held[1], 0.5, "it holds within half a second")
            before = position(server, 1)
            assert server.wait_told(LeaseEnded, lease=lease.id).why == "lost"
            assert time.monotonic() - left == pytest.approx(1.0, abs=0.5)
            assert position(server, 1) == before
            server.wait(lambda: [q for q in server.now.queue if q["robot"] == 1], why="it is in the queue")
            server.of.join("bob")
            assert server.wait_told(Offer, operator="bob", robot=1).reason == "asked"
            assert position(server, 1) == before
        assert len(list(samples_in(tmp_path))) >= 4, "what was recorded is kept"

    def test_a_person_who_freezes_is_treated_alike(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            drive(server, lease, 0.2, 0)
            server.wait(lambda: server.now.held[1], 0.8)
            assert server.wait_told(LeaseEnded, lease=lease.id, seconds=3.0).why == "expired"

    def test_heartbeats_keep_a_lease(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            for _ in range(15):
                server.of.renew("ann", lease.id)
                time.sleep(0.1)
            assert not server.told(LeaseEnded)


class TestEmergencyStop:
    def test_it_acts_at_once_and_until_it_is_cleared(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path, hz=20.0)) as server:
            lease = server.take("ann", 1)
            drive(server, lease, 0.2, 0)
            server.of.estop("ann", 1)
            before = position(server, 1)
            with pytest.raises(Denied):
                drive(server, lease, 0.2, 1)
            assert server.wait_told(LeaseEnded, lease=lease.id).why == "stopped"
            server.steps(5)
            assert position(server, 1) == before
            assert server.now.stopped.tolist() == [False, True, False, False]
            assert not server.now.online[1]
            with pytest.raises(Denied) as denied:
                server.of.take("ann", 1)
            assert denied.value.code == "stopped"
            server.of.clear_estop("ann", 1)
            server.wait(lambda: server.now.mode[1] != Mode.OFFLINE)
            assert not server.now.stopped.any()

    def test_all_robots(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            server.of.estop("ann", None)
            obs = server.of.engine.loop.obs
            server.wait(lambda: (server.now.mode == Mode.OFFLINE).all())
            before = server.of.engine.loop.obs[:, 0].copy()
            server.steps(5)
            assert (server.of.engine.loop.obs[:, 0] == before).all()
            assert obs.shape == (4, 4)

    def test_a_stop_outlives_the_server(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            server.of.estop("ann", 2)
        with Serving(config(tmp_path)) as server:
            assert server.now.stopped.tolist() == [False, False, True, False]
            server.steps(3)
            assert server.now.mode[2] == Mode.OFFLINE
            with pytest.raises(Denied):
                server.take("ann", 2)

    def test_no_such_robot(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server, pytest.raises(Denied) as denied:
            server.of.estop("ann", 9)
        assert denied.value.code == "unknown_robot"


class TestLockStep:
    def test_the_simulation_waits_for_who_holds_a_robot(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path, lockstep=True, hz=200.0)) as server:
            server.of.join("ann")
            server.of.take("ann", 1)
            lease = server.wait_told(LeaseGranted).lease
            time.sleep(0.2)
            t = server.now.t
            server.of.renew("ann", lease.id)
            time.sleep(0.3)
            assert server.now.t <= t + 1
            for seq in range(5):
                t = server.now.t
                drive(server, lease, 0.1, seq)
                server.wait(lambda t=t: server.now.t > t)
            time.sleep(0.1)
            assert server.now.t <= t + 2, "one timestep a command"
        samples = list(samples_in(tmp_path))
        assert len(samples) == 5

    def test_not_for_ever(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path, lockstep=True, hz=200.0, deadline=0.3)) as server:
            server.of.join("ann")
            server.of.take("ann", 1)
            lease = server.wait_told(LeaseGranted).lease
            t = server.now.t
            for _ in range(10):
                server.of.renew("ann", lease.id)
                time.sleep(0.1)
            assert server.now.t > t + 1


class TestNumbers:
    def test_metrics_say_what_happened(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            server.take("ann", 1)
            server.wait(lambda: len(server.told(Metrics)) >= 2)
            rows = server.of.metrics()
            assert rows[-1]["t"] > rows[0]["t"]
            wanted = {"successes", "hard_resets", "rohe", "intervention_rate", "idle_time", "human_steps", "queue_wait"}
            assert wanted <= set(rows[-1])
            assert server.of.metrics(since=rows[0]["t"]) == rows[1:] or len(server.of.metrics()) > len(rows)
            assert rows[-1]["human_steps"] > 0

    def test_the_server_says_how_late_it_is(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path, hz=20.0)) as server:
            server.steps(10)
            health = server.of.healthy
            assert health["ok"]
            assert health["loop"]
            assert 0 <= health["late"] < 1.0
            assert health["online"] == 4


def knock_over(server: Serving) -> int:
    """Wait until a robot falls by itself; if none does, push one over the edge."""
    fleet = server.of.engine.parts.fleet.inner
    with server.of.engine.lock:
        fleet.falls[fleet.t + 2] = [3]  # type: ignore[attr-defined]
    return int(server.wait(lambda: [r for r in range(4) if server.now.mode[r] != Mode.AUTONOMOUS])[0])


class TestCrowd:
    def test_people_who_do_everything_at_once_do_not_stop_the_loop(self, tmp_path: Path) -> None:
        """Threads ask for whatever comes to their minds; the loop goes on, and one robot has one holder."""
        calls = (
            "join",
            "leave",
            "accept",
            "decline",
            "take",
            "give_back",
            "reset",
            "hand_over",
            "available",
            "estop",
            "clear",
        )
        refused: list[str] = []

        def one(server: Serving, seed: int, end: float) -> None:
            rng = np.random.default_rng(seed)
            while time.monotonic() < end:
                name, robot = f"p{rng.integers(4)}", int(rng.integers(4))
                call = calls[rng.integers(len(calls))]
                lease = server.now.leases.get(robot)
                try:
                    if call in ("join", "leave"):
                        getattr(server.of, call)(name)
                    elif call == "hand_over":
                        server.of.hand_over(name, robot, f"p{rng.integers(4)}")
                    elif call == "available":
                        server.of.available(name, bool(rng.integers(2)))
                    elif call == "estop" and rng.random() < 0.05:
                        server.of.estop(name, robot)
                    elif call == "clear":
                        server.of.clear_estop(name, robot) if server.now.stopped[robot] else None
                    elif call not in ("estop", "clear"):
                        getattr(server.of, call)(name, robot)
                    for _ in range(3):
                        if lease:
                            server.of.command(
                                lease["operator"], robot, lease["id"], time.monotonic_ns(), [rng.uniform(-1, 1)]
                            )
                except Denied as denied:
                    refused.append(denied.code)
                time.sleep(0.001)

        with Serving(config(tmp_path, hz=200.0, humans=3)) as server:
            t, end = server.now.t, time.monotonic() + 4.0
            threads = [threading.Thread(target=one, args=(server, seed, end)) for seed in range(6)]
            for thread in threads:
                thread.start()
            while time.monotonic() < end:
                snapshot = server.now
                holders = [lease["operator"] for lease in snapshot.leases.values()]
                assert len(set(holders)) == len(holders)
                humans = snapshot.human[snapshot.human >= 0].tolist()
                assert len(set(humans)) == len(humans)
                time.sleep(0.01)
            for thread in threads:
                thread.join()
            assert server.of.healthy["error"] is None
            assert server.of.healthy["ok"]
            assert server.now.t > t + 50
        granted = [event.lease.id for event in server.told(LeaseGranted)]
        ended = [event.lease for event in server.told(LeaseEnded)]
        assert len(granted) > 20
        assert sorted(granted) == sorted(ended), "each lease that began has ended, once"
        assert set(refused) <= {
            "no_seat", "not_offered", "not_yours", "taken", "offline", "stopped", "stale_lease", "too_many", "unknown_person",
        }  # fmt: skip
