"""Robots on the network in people's hands: processes of their own, a router, and the supervision engine."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zenoh", reason="needs the extra sgc")

from floor import QUICK, LeaseEnded, Serving
from remote.field import Field

from tutelage.console.audit import samples_in
from tutelage.console.states import Denied
from tutelage.console.supervision import EngineConfig
from tutelage.fleet.modes import Mode
from tutelage.learning.imitation import LearnerConfig


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Field]:
    with Field(tmp_path_factory.mktemp("field"), 2) as made:
        made.router()
        yield made


def config(field: Field, out: Path, **changes: Any) -> EngineConfig:
    settings: dict[str, Any] = {
        "fleet": f"net:{field.server}", "humans": 2, "priority": "C.", "hz": 20.0, "learner": "none", "out": out,
        "terms": QUICK, "run": {"hidden": (8,), "members": 2}, "policy": "none",
    }  # fmt: skip
    return EngineConfig(**{**settings, **changes})


def all_there(server: Serving) -> None:
    server.wait(lambda: server.now.online.all(), 30.0, "robots are not in reach")
    server.wait(lambda: (server.now.mode != Mode.OFFLINE).all())


def test_a_person_drives_a_robot_over_the_network(field: Field, tmp_path: Path) -> None:
    field.revive()
    with Serving(config(field, tmp_path)) as server:
        all_there(server)
        assert server.of.description.robots == tuple(server.of.engine.parts.fleet.inner.names)  # type: ignore[attr-defined]
        lease = server.take("ann", 0)
        since = time.monotonic()
        for seq in range(20):
            server.of.command("ann", 0, lease.id, seq, [0.5, -0.25])
            server.steps(1)
        moved = [note for note in field.notes(1, since, "act") if note.words == ("0.5", "-0.25")]
        assert len(moved) >= 10
        server.of.give_back("ann", 0)
        server.wait_told(LeaseEnded, lease=lease.id)
    samples = list(samples_in(tmp_path))
    assert len(samples) >= 15
    assert samples[0].arrays["wanted"] == pytest.approx([0.5, -0.25])


def test_a_silent_person_means_a_robot_that_holds_itself(field: Field, tmp_path: Path) -> None:
    field.revive()
    with Serving(config(field, tmp_path)) as server:
        all_there(server)
        lease = server.take("ann", 1)
        server.of.command("ann", 1, lease.id, 0, [0.1, 0.1])
        server.wait(lambda: not server.now.held[1])
        server.wait(lambda: server.now.held[1], 2.0)
        held = time.monotonic()
        server.wait(lambda: field.notes(2, held - 0.2, "hold"), 1.0, "the robot was not told to hold")
        for _ in range(5):
            server.of.renew("ann", lease.id)
            time.sleep(0.1)
        assert not field.notes(2, held + 0.15, "act")


def test_an_emergency_stop_reaches_the_robot_at_once(field: Field, tmp_path: Path) -> None:
    field.revive()
    with Serving(config(field, tmp_path)) as server:
        all_there(server)
        lease = server.take("ann", 0)
        server.of.command("ann", 0, lease.id, 0, [0.1, 0.1])
        server.steps(2)
        since = time.monotonic()
        server.of.estop("ann", 0)
        stopped = server.wait(lambda: field.notes(1, since, "stop"), 2.0, "the robot was not stopped")
        assert stopped[0].time - since < 0.2
        assert server.wait_told(LeaseEnded, lease=lease.id).why == "stopped"
        server.wait(lambda: server.now.stopped[0])
        assert not field.moves(1, stopped[0].time + 0.05)
        server.of.clear_estop("ann", 0)
        server.wait(lambda: server.now.online[0] and server.now.mode[0] == Mode.AUTONOMOUS, 10.0)


def test_a_killed_robot_ends_its_lease_and_comes_back(field: Field, tmp_path: Path) -> None:
    field.revive()
    with Serving(config(field, tmp_path)) as server:
        all_there(server)
        lease = server.take("ann", 1)
        field.kill(2)
        assert server.wait_told(LeaseEnded, lease=lease.id).why == "offline"
        server.wait(lambda: server.now.mode[1] == Mode.OFFLINE)
        with pytest.raises(Denied) as denied:
            server.of.take("ann", 1)
        assert denied.value.code == "offline"
        t = server.now.t
        server.steps(5)
        assert server.now.t > t, "the others go on"
        field.revive()
        server.wait(lambda: server.now.mode[1] != Mode.OFFLINE, 30.0)


def test_the_server_starts_again_and_goes_on(field: Field, tmp_path: Path) -> None:
    field.revive()
    with Serving(config(field, tmp_path)) as server:
        all_there(server)
        server.steps(10)
        t = server.now.t
    with Serving(config(field, tmp_path)) as server:
        all_there(server)
        assert server.now.t >= t
        lease = server.take("ann", 0)
        server.of.command("ann", 0, lease.id, 0, [0.0, 0.0])
        server.steps(2)
        assert np.isfinite(server.of.engine.loop.obs).all()


def test_robots_at_a_known_task_begin_with_a_clone_of_its_expert_and_get_what_people_taught(tmp_path: Path) -> None:
    run = {"offline_pairs": 200, "learner": LearnerConfig(pretrain=10, batch=16), "members": 2, "hidden": (8,)}
    with Field(tmp_path / "maze", 1) as maze:
        maze.router()
        maze.robot(1, "--hz", 20, "--policy", env="Navigation", wait=False)
        changes = {"policy": None, "learner": "process", "priority": "U.C.", "swap_every": 0.2, "run": run, "humans": 1}
        with Serving(config(maze, tmp_path / "out", **changes)) as server:
            assert server.of.description.task == "Navigation"
            pointer = server.of.description.controls.pointer
            assert pointer is not None
            assert pointer.kind == "go"
            all_there(server)
            lease = server.take("ann", 0)
            for seq in range(20):
                server.of.command("ann", 0, lease.id, seq, None, assist=True)
                server.steps(1)
                server.of.jpeg(0, 0)
            assert server.of.jpeg(0, 0) is not None
            server.of.give_back("ann", 0)
            server.wait(lambda: server.now.policy_version > 0, 40.0, "nothing was learned")
            engine: Any = server.of.engine
            server.wait(lambda: engine.parts.fleet.inner.proposals()[1][0] == engine._shared.version, 20.0, "no new weights")
