"""What the tests of proxies share."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sgc.fleets import Fleet
from sgc.proxies.company import CYCLONE, Company, stay_on_loopback
from sgc.proxies.rclpy_ends import RosNodes

stay_on_loopback()
_domains = itertools.cycle(range(1, 80))
_SAFE_DOMAINS = [*range(80, 102), *range(215, 232)]
"""From 80 on, those whose ports the system gives to no program by chance."""
_first = os.getpid() % len(_SAFE_DOMAINS)
_ros_domains = itertools.cycle(_SAFE_DOMAINS[_first:] + _SAFE_DOMAINS[:_first])


@pytest.fixture
def domains() -> Iterator[int]:
    """DDS domains that no other test has at the same time: `next(domains)`. From 80 on they are for Fast DDS."""
    return _domains


@pytest.fixture
def ros_domains(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[int]:
    """Domains on which rclpy and Cyclone DDS find each other, on this machine only; they have no tag, see `company`."""
    monkeypatch.setenv("CYCLONEDDS_URI", CYCLONE.format(tag=""))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))
    return _ros_domains


@pytest.fixture
def ros_nodes() -> Iterator[RosNodes]:
    """`ros_nodes(domain, name)`: a ROS 2 node in a process of its own, see `rclpy_ends`."""
    made = RosNodes()
    yield made
    made.close()


@pytest.fixture
def company(tmp_path: Path) -> Iterator[Callable[..., Company]]:
    """`company(policy, "robot", "server")`: nodes with real keys, closed after the test."""
    made: list[Company] = []

    def make(policy: str, *names: str) -> Company:
        made.append(Company(Fleet(tmp_path / f"fleet{len(made)}", policy, names)))
        return made[-1]

    yield make
    for each in made:
        each.close()
