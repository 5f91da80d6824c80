"""One fleet of processes for the tests: a router and three robots, all of them at 20 Hz."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from remote.field import Field, said

from tutelage.remote.fleet import RemoteFleet


@pytest.fixture(scope="session")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Field]:
    pytest.importorskip("zenoh", reason="needs the extra sgc")
    with Field(tmp_path_factory.mktemp("field"), 3) as made:
        made.router()
        yield made


@pytest.fixture
def fleet(field: Field) -> Iterator[RemoteFleet]:
    """A server in this process, once all three robots are in reach and well."""
    field.revive()
    made = RemoteFleet.connect(field.server, hz=20.0)
    try:
        made.reset()
        go = np.zeros((3, 2), np.float32)
        for _ in range(300):
            made.clear()
            if made.step(go)[-1]["online"].all():
                break
        else:
            told = [said(robot)[-500:] for robot in field.robots.values()]
            raise AssertionError(made.status(), told, made.node.counters())
        yield made
    finally:
        made.close()
