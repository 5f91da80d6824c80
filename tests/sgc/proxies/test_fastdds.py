"""A second DDS vendor: a Fast DDS program (C++) on one domain, a Cyclone DDS one on another, joined through the fleet.

Needs a C++ compiler and Debian's libfastrtps-dev (Fast DDS 2.9, as in ROS 2 Humble's time); skipped elsewhere.
"""

from __future__ import annotations

import ctypes.util
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from sgc.fleets import topic
from sgc.proxies.company import CYCLONE
from sgc.proxies.ros_ends import RosNode, taken, until
from sgc.proxies.test_ros2 import BOTH, chat, proxy

from tutelage.sgc.proxies.ros_topics import Inward

SOURCE = Path(__file__).parent / "fastdds" / "chatter.cpp"
HEADERS = Path("/usr/include/fastdds/dds/domain/DomainParticipant.hpp")
COUNT = 300

pytestmark = pytest.mark.skipif(
    not (shutil.which("g++") and HEADERS.exists() and ctypes.util.find_library("fastrtps")),
    reason="Fast DDS or a C++ compiler is not installed (Debian: g++ libfastrtps-dev libfastcdr-dev)",
)


@pytest.fixture(scope="module")
def chatter(tmp_path_factory) -> Path:
    """The program, compiled."""
    program = tmp_path_factory.mktemp("fastdds") / "chatter"
    command = ["g++", "-std=c++17", "-O0", "-o", str(program), str(SOURCE), "-lfastrtps", "-lfastcdr"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return program


@pytest.fixture
def fast_domain(domains, monkeypatch) -> int:
    """A domain without the tag that keeps test runs apart, which Fast DDS does not know."""
    monkeypatch.setenv("CYCLONEDDS_URI", CYCLONE.format(tag=""))
    return 80 + os.getpid() % 20


def test_fast_dds_and_cyclone_dds_exchange_messages_both_ways_in_order(chatter, company, domains, fast_domain):
    there = next(domains)
    robot, server = company(topic("chat", ["robot", "server"], ["robot", "server"]), "robot", "server")
    texts = [f"message {i}" for i in range(COUNT)]
    with proxy(robot, chat(fast_domain, **BOTH)) as one, proxy(server, chat(there, **BOTH)):
        node = RosNode(there)
        listener = node.subscription("/chatter")
        assert until(listener.get_matched_publications)
        arguments = [str(fast_domain), "rt/chatter", str(COUNT)]
        subprocess.run([str(chatter), "pub", *arguments], check=True, timeout=60)
        assert taken(listener, COUNT, 20.0) == texts
        hears = subprocess.Popen([str(chatter), "sub", *arguments], stdout=subprocess.PIPE, text=True)
        try:
            (inward,) = (part for part in one._parts if isinstance(part, Inward))
            assert until(lambda: inward._writer.matched, 20.0), "Fast DDS's subscription was not found"
            node.say("/chatter", texts)
            assert hears.communicate(timeout=60)[0].splitlines() == texts
        finally:
            hears.kill()
