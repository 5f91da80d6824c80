"""Scripted operators: they work through the page's sockets, against a real server, loop and learner."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from consoles import PASSWORD, Running
from floor import config
from test_frames import pushing

from tutelage.console.audit import samples_in
from tutelage.console.scripted import ScriptedOperator, after
from tutelage.console.supervision import Supervision
from tutelage.errors import ConfigError
from tutelage.fleet.priority import PriorityConfig
from tutelage.learning.imitation import LearnerConfig


@pytest.fixture
def pushers(tmp_path: Path) -> Iterator[Running]:
    """Blocks pushed by a policy that knows nothing and always asks."""
    run = {
        "offline_pairs": 60,
        "learner": LearnerConfig(pretrain=10, batch=16),
        "thresholds": PriorityConfig(uncertainty=0.0),
    }
    settings = pushing(tmp_path, priority="U.C.", hz=20.0, policy=None, run=run)
    server = Running(tmp_path, lambda audit: Supervision.open(settings, audit))
    yield server
    server.close()


def test_they_help_whoever_asks(pushers: Running) -> None:
    people = [
        ScriptedOperator(pushers.origin, name, PASSWORD, react=0.1, rule=after(8), streams=[{"robot": 0, "fps": 10.0}])
        for name in ("ana", "operator")
    ]

    async def work() -> list[Any]:
        return await asyncio.gather(*(person.run(6.0) for person in people))

    for tally in asyncio.run(work()):
        assert tally.interventions >= 2
        assert tally.commands > 10
        assert sum(tally.ends.values()) >= tally.interventions - 1
        assert set(tally.ends) <= {"given_back", "completed", "violated", "reset_done"}
        assert tally.pictures > 10
        assert max(tally.round_trips) < 2.0
    kept = list(samples_in(pushers.folder))
    assert {sample.who for sample in kept} == {"ana", "operator"}
    rows = {row["operator"]: row for row in people[0].get("/api/operators")["rows"]}
    assert rows["ana"]["interventions"] == people[0].tally.interventions


def test_they_may_drive_by_themselves(tmp_path: Path) -> None:
    server = Running(tmp_path, lambda audit: Supervision.open(config(tmp_path, hz=20.0), audit))
    try:
        fleet = server.supervision.engine.parts.fleet.inner
        fleet.falls[fleet.t + 10] = [2]
        person = ScriptedOperator(server.origin, "ana", PASSWORD, react=0.0, act=lambda state, robot: [0.1])
        tally = asyncio.run(person.run(20.0, until=lambda: person.tally.resets > 0))
        assert tally.resets == 1
        assert set(tally.errors) <= {"stale_lease"}, "a heartbeat may cross the end of the lease"
    finally:
        server.close()


def test_a_wrong_password_is_one_line(pushers: Running) -> None:
    with pytest.raises(ConfigError, match="ana cannot log in"):
        asyncio.run(ScriptedOperator(pushers.origin, "ana", "wrong").run(1.0))


@pytest.mark.parametrize(("address", "why"), [("ana", "no address"), ("http://127.0.0.1:1", "no console answers")])
def test_no_console_there(address: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        asyncio.run(ScriptedOperator(address, "ana", "x").run(1.0))
