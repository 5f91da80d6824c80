"""Services and actions of ROS 2 across the fleet, as Cyclone DDS's middleware has them on the wire."""

from __future__ import annotations

import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from sgc.fleets import service, topic
from sgc.proxies.ros_ends import ADD, RELIABLE, AddClient, AddServer, RosNode, cdr, until

from tutelage.errors import ConfigError
from tutelage.sgc.proxies import dds_raw
from tutelage.sgc.proxies.dds_services import _split, _with_identity
from tutelage.sgc.proxies.ros2 import Ros2Proxy
from tutelage.sgc.proxies.ros_names import service_channels
from tutelage.sgc.proxies.ros_types import RosTypes
from tutelage.sgc.proxies.ros_values import Codec
from tutelage.sgc.proxies.routes import Routes, ServiceRoute, parse_routes
from tutelage.sgc.service import RequestFailed

ADDING = service("add", ["robot"], ["server", "console"], type=ADD)


def offered(domain, timeout=5.0):
    """The server is on this domain."""
    return Routes((), (ServiceRoute("add", "/add", ADD, True, timeout, domain=domain),))


def used(domain, timeout=5.0):
    """Clients are on this domain."""
    return Routes((), (ServiceRoute("add", "/add", ADD, False, timeout, domain=domain),))


def counts(proxy, alias="add"):
    return proxy.counters()["topics"][alias]


def test_a_client_on_one_domain_is_answered_by_a_server_on_another(company, domains):
    here, there = next(domains), next(domains)
    robot, server, _ = company(ADDING, "robot", "server", "console")
    adder = AddServer(here)
    with Ros2Proxy(robot, offered(here)) as out, Ros2Proxy(server, used(there)) as into:
        client = AddClient(there)
        assert [client.call(a, 2**40) for a in (1, -2, 3)] == [2**40 + 1, 2**40 - 2, 2**40 + 3]
        assert adder.asked == [(1, 2**40), (-2, 2**40), (3, 2**40)]
        assert counts(out)["replies"] == counts(into)["replies"] == 3
    adder.close()


def test_replies_find_the_client_that_asked(company, domains):
    here, there = next(domains), next(domains)
    robot, server, _ = company(ADDING, "robot", "server", "console")
    adder = AddServer(here, delay=0.02)
    with Ros2Proxy(robot, offered(here)), Ros2Proxy(server, used(there)), ThreadPoolExecutor() as pool:
        clients = [AddClient(there, client=i) for i in range(4)]
        sums = list(pool.map(lambda i: clients[i].call(i, 100), range(4)))
        assert sums == [100, 101, 102, 103]
    adder.close()


def test_a_program_of_the_fleet_asks_a_ros_server(company, domains):
    here = next(domains)
    robot, _, console = company(ADDING, "robot", "server", "console")
    types = RosTypes("jazzy")
    asks, answers = (Codec(types, name) for name in types.need_service(ADD))
    adder = AddServer(here)
    with Ros2Proxy(robot, offered(here)):
        reply = console.request("add", asks.serialize({"a": 20, "b": 22}), timeout=5.0)
        assert answers.values(reply) == {"sum": 42}
    adder.close()


def test_without_a_server_the_requester_is_told_and_a_ros_client_waits_in_vain(company, domains):
    here, there = next(domains), next(domains)
    robot, server, console = company(ADDING, "robot", "server", "console")
    with Ros2Proxy(robot, offered(here, timeout=0.4)) as out, Ros2Proxy(server, used(there, timeout=1.0)) as into:
        with pytest.raises(RequestFailed, match=rf"there is no ROS 2 server of /add on domain {here}"):
            console.request("add", cdr("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0), timeout=3.0)
        assert AddClient(there).call(1, 2, timeout=1.5) is None
        assert until(lambda: counts(into)["no_reply"] == 1)
        assert counts(out)["no_reply"] == 2


def test_a_slow_server_is_given_up_and_its_late_reply_ignored(company, domains):
    here = next(domains)
    robot, _, console = company(ADDING, "robot", "server", "console")
    adder = AddServer(here, delay=0.6)
    message = b"\0\1\0\0" + bytes(16)
    with Ros2Proxy(robot, offered(here, timeout=0.5)):
        with pytest.raises(RequestFailed, match="did not answer within"):
            console.request("add", message, timeout=3.0)
        time.sleep(0.5)
    adder.close()


def test_without_rclpy_a_service_that_goes_through_it_is_one_line(company, domains, monkeypatch):
    robot, _, _ = company(ADDING, "robot", "server", "console")
    monkeypatch.setitem(sys.modules, "rclpy", None)
    through = ServiceRoute("add", "/add", ADD, True, domain=next(domains), through="rclpy")
    with pytest.raises(
        ConfigError, match=r"rclpy cannot be imported .*; run: source /opt/ros/<distribution>/setup.bash, or pip"
    ):
        Ros2Proxy(robot, Routes((), (through,)))


@pytest.mark.parametrize("payload", [b"", b"x", b"\0\1\0\0", b"\xff" * 50])
def test_a_request_that_is_no_message_never_reaches_the_domain(company, domains, payload):
    here = next(domains)
    robot, _, console = company(ADDING, "robot", "server", "console")
    adder = AddServer(here)
    with Ros2Proxy(robot, offered(here)) as out:
        with pytest.raises(RequestFailed, match="no serialized message"):
            console.request("add", payload, timeout=3.0)
        assert counts(out)["malformed"] == 1
    assert adder.asked == []
    adder.close()


def test_identities_are_put_in_and_taken_out_without_moving_the_content():
    message, identity = b"\0\1\0\0" + b"content!", bytes(range(16))
    assert _split(b"".join(_with_identity(message, identity))) == (identity, message)
    assert _split(b"\0\1\0\0" + identity) is None


class RawService:
    """A server, or a client, of a service whose messages are bytes: 4 of CDR, 16 of identity, then the content."""

    def __init__(self, domain, name, type_name, *, serves):
        self._node = RosNode(domain)
        requests, replies = service_channels(name, type_name)
        hears, says = (requests, replies) if serves else (replies, requests)
        participant = self._node.participant
        self.reader = DataReader(participant, dds_raw.raw_topic(participant, hears), qos=RELIABLE)
        self.writer = DataWriter(participant, dds_raw.raw_topic(participant, says), qos=RELIABLE)

    @property
    def matched(self):
        return self.reader.get_matched_publications() and self.writer.get_matched_subscriptions()

    def take(self):
        return until(lambda: dds_raw.take(self.reader))[0].data


def test_an_actions_goal_feedback_and_result_cross(company, domains):
    """An action is three services and two topics; its server and client are played by bytes under its names."""
    here, there = next(domains), next(domains)
    parts = ("send_goal", "cancel_goal", "get_result")
    policy = "".join(service(f"fold-{part}", ["robot"], ["server"], interface=f"/{part}") for part in parts)
    policy += "".join(topic(f"fold-{part}", ["robot"], ["server"], interface=f"/{part}") for part in ("feedback", "status"))
    robot, server = company(policy, "robot", "server")

    def action(node, direction, domain):
        entry = {"alias": "fold", "name": "/fold", "type": "p/action/Fold", "direction": direction, "domain": domain}
        return parse_routes({"version": 1, "action": [entry]}, node.access)

    with Ros2Proxy(robot, action(robot, "out", here)) as out, Ros2Proxy(server, action(server, "in", there)):
        assert set(out.counters()["topics"]) == {f"fold-{part}" for part in (*parts, "feedback", "status")}
        for part, kind in (("send_goal", "SendGoal"), ("get_result", "GetResult")):
            serves = RawService(here, f"/fold/_action/{part}", f"p/action/Fold_{kind}", serves=True)
            asks = RawService(there, f"/fold/_action/{part}", f"p/action/Fold_{kind}", serves=False)
            assert until(lambda asks=asks: asks.matched)
            identity = bytes(range(16))
            dds_raw.write(asks.writer, b"\0\1\0\0", identity, b"the request")
            request = serves.take()
            assert request[20:] == b"the request"
            dds_raw.write(serves.writer, request[:20], b"the response")
            assert asks.take() == b"\0\1\0\0" + identity + b"the response"
        feedback = "p/action/Fold_FeedbackMessage"
        hears = RosNode(there).raw_subscription("/fold/_action/feedback", feedback)
        says = RosNode(here).raw_publisher("/fold/_action/feedback", feedback)
        assert until(says.get_matched_subscriptions)
        assert until(hears.get_matched_publications)
        dds_raw.write(says, b"\0\1\0\0half done")
        assert until(lambda: dds_raw.take(hears))[0].data == b"\0\1\0\0half done"
