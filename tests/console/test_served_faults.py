"""What breaks: the server's process, the disk, clocks. No acknowledged intervention is lost, and robots hold."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from floor import LeaseEnded, Notice, Serving, Stepped, config

from tutelage.console.audit import Audit, RecordError, samples_in, verify_folder
from tutelage.console.states import Denied
from tutelage.console.supervision import Supervision
from tutelage.errors import TutelageError
from tutelage.fleet.modes import Mode

SERVER = """
import sys, json
from pathlib import Path
sys.path[:0] = json.loads(sys.argv[2])
from floor import *
from tutelage.learning.imitation import LearnerConfig

with Serving(config(Path(sys.argv[1]), hz=50.0, learner="process", save_every=0.3, swap_every=0.1,
                    run={"learner": LearnerConfig(every=10**6, batch=16)})) as server:
    k = 0
    while True:
        robot, k = k % 4, k + 1
        lease = server.take("ann", robot)
        for seq in range(6):
            server.of.command("ann", robot, lease.id, seq, [0.02])
            server.steps(1)
        server.of.give_back("ann", robot)
        server.wait_told(LeaseEnded, lease=lease.id)
        print(json.dumps({"lease": lease.id, "version": server.now.policy_version, "t": server.now.t}), flush=True)
"""
"""A server, and somebody who drives robots in turn and says which interventions were acknowledged."""


def acknowledged(out: Path, seconds: float) -> list[dict[str, Any]]:
    """Run the server, kill it -9 in the middle of its work, and return what it acknowledged."""
    process = subprocess.Popen(
        [sys.executable, "-c", SERVER, str(out), json.dumps(sys.path)], stdout=subprocess.PIPE, start_new_session=True
    )
    assert process.stdout is not None
    said = [process.stdout.readline()]
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        said.append(process.stdout.readline())
    os.killpg(process.pid, signal.SIGKILL)
    said += process.stdout.read().splitlines()
    process.wait()
    return [json.loads(line) for line in said if line.strip().endswith(b"}")]


class TestKilled:
    def test_no_acknowledged_intervention_is_lost_and_the_server_goes_on(self, tmp_path: Path) -> None:
        known = acknowledged(tmp_path, 4.0)
        assert len(known) >= 3
        kept = {sample.fields["lease"] for sample in samples_in(tmp_path)}
        assert {said["lease"] for said in known} <= kept
        assert verify_folder(tmp_path).ok
        with Serving(config(tmp_path)) as server:
            assert not server.now.leases, "leases do not outlive the server"
            assert server.now.policy_version >= max(said["version"] for said in known)
            assert 0 < server.now.t <= known[-1]["t"] + 60
            server.steps(3)
            assert (server.now.mode == Mode.AUTONOMOUS).all()

    def test_a_server_that_was_stopped_goes_on_where_it_was(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            for seq in range(4):
                server.of.command("ann", 1, lease.id, seq, [0.1])
                server.steps(1)
            server.of.estop("ann", None)
            server.steps(3)
        last = server.of.engine.loop
        with Serving(config(tmp_path, hz=0.5)) as again:
            loop = again.of.engine.loop
            assert last.t <= loop.t <= last.t + 1
            assert (loop.obs == last.obs).all()
            assert again.now.stopped.all()
            assert again.of.engine.recorder.tally.summary()["teleoperation"] > 0
            rows = {row["operator"]: row for row in again.of.operators()}
            assert rows["ann"]["interventions"] == 1

    def test_a_server_that_was_killed_before_its_first_timestep(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)):
            pass
        (tmp_path / "checkpoint" / "serve.safetensors").unlink()
        with Serving(config(tmp_path)) as server:
            server.steps(2)

    @pytest.mark.parametrize(
        "name", ["serve.json", "config.json", "checkpoint/learner.safetensors", "checkpoint/serve.safetensors"]
    )
    def test_a_damaged_folder_is_one_clear_line(self, tmp_path: Path, name: str) -> None:
        with Serving(config(tmp_path)):
            pass
        (tmp_path / name).write_bytes(b"{]")
        with pytest.raises(TutelageError, match="damaged") as problem, Serving(config(tmp_path)):
            pass
        assert "\n" not in str(problem.value)

    def test_two_servers_do_not_share_a_folder(self, tmp_path: Path) -> None:
        from tutelage.errors import RunFolderError

        with Serving(config(tmp_path)) as server, pytest.raises(RunFolderError, match="in use"):
            Supervision.open(config(tmp_path), server.audit)

    def test_a_folder_is_not_served_as_something_else(self, tmp_path: Path) -> None:
        from tutelage.errors import RunFolderError

        with Serving(config(tmp_path)):
            pass
        with pytest.raises(RunFolderError, match="--robots 4"), Serving(config(tmp_path, robots=3)):
            pass


class FullDisk(Audit):
    """A record on a disk that is full while `full` says so."""

    full = False

    def _fail(self) -> None:
        if self.full:
            raise RecordError("disk full")

    @property
    def error(self) -> str | None:
        return "disk full" if self.full else super().error

    def write(self, *arguments: Any, **fields: Any) -> None:
        self._fail()
        super().write(*arguments, **fields)

    def sample(self, *arguments: Any, **fields: Any) -> None:
        self._fail()
        super().sample(*arguments, **fields)

    def flush(self, timeout: float = 10.0) -> None:
        self._fail()
        super().flush(timeout)


class TestFullDisk:
    def test_robots_are_held_and_people_are_told_until_there_is_room(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("floor.Audit", FullDisk)
        with Serving(config(tmp_path)) as server:
            audit: Any = server.audit
            lease = server.take("ann", 1)
            for seq in range(5):
                server.of.command("ann", 1, lease.id, seq, [0.01])
                server.steps(1)
            audit.full = True
            with pytest.raises(Denied) as refused:
                server.of.command("ann", 1, lease.id, 6, [0.01])
            assert refused.value.code == "held"
            assert "disk full" in server.wait_told(Notice, level="error").text
            assert "they go on as soon as" in server.wait_told(Notice, level="error").text
            t, before = server.of.engine.loop.t, server.of.engine.loop.obs[:, 0].copy()
            time.sleep(0.4)
            assert server.of.engine.loop.t == t
            assert (server.of.engine.loop.obs[:, 0] == before).all()
            assert not server.of.healthy["ok"]
            server.of.join("bob")
            with pytest.raises(Denied) as denied:
                server.of.take("bob", 2)
            assert denied.value.code == "held"
            audit.full = False
            server.wait_told(Notice, level="info")
            server.wait(lambda: server.of.engine.loop.t > t + 3)
            assert server.of.healthy["ok"]
            server.of.take("bob", 2)
        executed = [sample.fields["t"] for sample in samples_in(tmp_path)]
        assert executed == sorted(executed)
        assert len(executed) >= 5, "the sample that could not be written at first is there as well"

    def test_a_lease_that_ended_is_acknowledged_when_it_is_on_the_disk(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("floor.Audit", FullDisk)
        with Serving(config(tmp_path)) as server:
            audit: Any = server.audit
            lease = server.take("ann", 1)
            audit.full = True
            server.of.give_back("ann", 1)
            server.wait_told(Notice, level="error")
            time.sleep(0.3)
            assert not server.told(LeaseEnded)
            audit.full = False
            server.wait_told(LeaseEnded, lease=lease.id)


class TestLoopDies:
    def test_people_are_told_and_robots_hold(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            server.of.engine.parts.fleet.inner.step_wait = None  # type: ignore[assignment]
            assert "robots hold" in server.wait_told(Notice, level="error").text
            health = server.of.healthy
            assert not health["ok"]
            assert not health["loop"]
            assert health["error"]


class TestClocks:
    def test_only_the_servers_clock_counts(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """The time of day jumps by an hour; leases and commands do not care."""
        with Serving(config(tmp_path)) as server:
            lease = server.take("ann", 1)
            real = time.time
            monkeypatch.setattr(time, "time", lambda: real() + 3600.0)
            for seq in range(10):
                server.of.command("ann", 1, lease.id, seq, [0.01])
                server.steps(1)
            assert not server.told(LeaseEnded)
            assert not server.now.held[1]

    def test_events_come_in_order(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            server.steps(20)
            ts = [event.snapshot.t for event in server.told(Stepped)]
            assert ts == sorted(ts)
            assert len(set(ts)) == len(ts)
