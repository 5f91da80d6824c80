"""roslibpy, unchanged, publishes, subscribes and uses services through rosbridges of two nodes."""

from __future__ import annotations

import pytest
import roslibpy
from sgc.fleets import service, topic
from sgc.proxies.ros_ends import ADD, until

from tutelage.sgc.proxies.ros_types import RosTypes
from tutelage.sgc.proxies.rosbridge import Bridge
from tutelage.sgc.proxies.routes import all_routes

POLICY = topic("chat", ["site-a", "site-b"], ["site-a", "site-b"], interface="/chatter") + service(
    "add", ["site-a"], ["site-b"], type=ADD
)
TYPES = RosTypes("jazzy")


@pytest.fixture
def clients(company):
    """One at each site."""
    bridges = [Bridge(node, all_routes(node.access), TYPES, port=0) for node in company(POLICY, "site-a", "site-b")]
    clients = [roslibpy.Ros(*bridge.address) for bridge in bridges]
    for client in clients:
        client.run(timeout=10)
    yield clients
    for client in clients:
        client.close()
    for bridge in bridges:
        bridge.close()


def test_300_messages_go_from_site_to_site_in_order(clients):
    here, there = clients
    heard: list[str] = []
    listener = roslibpy.Topic(there, "/chatter", "std_msgs/String")
    listener.subscribe(lambda message: heard.append(message["data"]))
    own: list[str] = []
    roslibpy.Topic(here, "/chatter", "std_msgs/msg/String").subscribe(lambda message: own.append(message["data"]))
    assert until(lambda: listener.is_subscribed)
    talker = roslibpy.Topic(here, "/chatter", "std_msgs/String")
    texts = [f"message {i}" for i in range(300)]

    def heard_something():
        talker.publish(roslibpy.Message({"data": "are you there?"}))
        return until(lambda: heard and own, 0.5)

    assert until(heard_something)
    for text in texts:
        talker.publish(roslibpy.Message({"data": text}))
    assert until(lambda: heard[-1:] == own[-1:] == texts[-1:])
    assert [text for text in heard if text in texts] == [text for text in own if text in texts] == texts


def test_a_service_of_one_site_is_called_from_the_other(clients):
    here, there = clients

    def add(request, response):
        response["sum"] = request["a"] + request["b"]
        return True

    offered = roslibpy.Service(here, "/add", "example_interfaces/AddTwoInts")
    offered.advertise(add)
    asked = roslibpy.Service(there, "/add", "example_interfaces/srv/AddTwoInts")
    assert asked.call(roslibpy.ServiceRequest({"a": 2**40, "b": 2}), timeout=10) == {"sum": 2**40 + 2}
    offered.unadvertise()


def test_it_can_look_around(clients):
    here, _ = clients
    assert here.get_topics() == ["/chatter"]
    assert here.get_topic_type("/chatter") == "std_msgs/msg/String"
    assert here.get_services() == ["/add"]
    assert here.get_service_type("/add") == ADD
    assert here.get_time().secs > 0
