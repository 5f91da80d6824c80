"""Two ROS 2 domains joined over a real Zenoh router with TLS, access control and sealing."""

from __future__ import annotations

import pytest
from sgc.fleets import behind_a_router, service, topic
from sgc.proxies.ros_ends import ADD, STRING, AddClient, AddServer, RosNode, taken, until
from sgc.proxies.test_ros2 import DEEP

from tutelage.sgc.node import Node
from tutelage.sgc.proxies.ros2 import Ros2Proxy
from tutelage.sgc.proxies.routes import Routes, ServiceRoute, TopicRoute

POLICY = topic("chat", ["robot", "server"], ["robot", "server"]) + service("add", ["robot"], ["server"], type=ADD)


@pytest.fixture
def nodes(tmp_path):
    """Robot and server, each dialling out to a router that can read nothing."""
    with (
        behind_a_router(tmp_path, POLICY, ["robot", "server"]) as fleet,
        Node.open(fleet["robot"].path) as robot,
        Node.open(fleet["server"].path) as server,
    ):
        assert until(lambda: robot.connected and server.connected)
        yield robot, server


def routes(domain, **ways):
    chat = TopicRoute("chat", "/chatter", STRING, True, True, qos=DEEP, domain=domain, queue=400)
    return Routes((chat,), (ServiceRoute("add", "/add", ADD, ways["outward"], domain=domain),))


def test_300_messages_each_way_in_order_and_services(nodes, domains):
    here, there = next(domains), next(domains)
    robot, server = nodes
    adder = AddServer(here)
    with Ros2Proxy(robot, routes(here, outward=True)), Ros2Proxy(server, routes(there, outward=False)):
        a, b = RosNode(here), RosNode(there)
        hears_a, hears_b = a.subscription("/chatter"), b.subscription("/chatter")
        assert until(hears_a.get_matched_publications)
        assert until(hears_b.get_matched_publications)
        texts = [f"message {i}" for i in range(300)]
        says_a = a.say("/chatter", texts)
        assert taken(hears_b, 300, 20.0) == texts
        says_b = b.say("/chatter", texts)
        heard = taken(hears_a, 600, 20.0)
        assert sorted(heard) == sorted(texts * 2)  # its own domain's, and those from afar
        assert AddClient(there).call(40, 2) == 42
        del says_a, says_b
    adder.close()
