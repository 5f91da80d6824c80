"""What the tests of proxies share."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sgc.fleets import Fleet
from sgc.proxies.company import Company, stay_on_loopback

stay_on_loopback()
_domains = itertools.cycle(range(1, 80))


@pytest.fixture
def domains() -> Iterator[int]:
    """DDS domains that no other test has at the same time: `next(domains)`. From 80 on they are for Fast DDS."""
    return _domains


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
