"""One fleet of processes for the tests of a module: a router and three robots, all of them at 20 Hz."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from remote.field import Field

from tutelage.remote.fleet import RemoteFleet

EXTRA = """
[topics.flood]
node = "robot-3"
interface = "/flood"
type = "std_msgs/msg/String"
owner = "server"
publish = ["server"]
subscribe = ["robot-3"]
"""


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Field]:
    pytest.importorskip("zenoh", reason="needs the extra sgc")
    with Field(tmp_path_factory.mktemp("field"), 3, EXTRA) as made:
        made.router()
        robots = [made.robot(number, "--hz", 20, wait=False) for number in (1, 2, 3)]
        made.robots = dict(enumerate(robots, 1))  # type: ignore[attr-defined]
        yield made


@pytest.fixture
def fleet(field: Field) -> Iterator[RemoteFleet]:
    """A server in this process, once all three robots are in reach and well."""
    with_fleet = RemoteFleet.connect(field.server, hz=20.0)
    try:
        with_fleet.reset()
        go = np.zeros((3, 2), np.float32)
        for _ in range(300):
            with_fleet.clear()
            if with_fleet.step(go)[-1]["online"].all():
                break
        else:
            raise AssertionError(with_fleet.status())
        yield with_fleet
    finally:
        with_fleet.close()
