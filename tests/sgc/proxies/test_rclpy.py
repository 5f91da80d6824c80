"""Topics of unchanged ROS 2 nodes (rclpy, under the middleware that is installed) through proxies: `make ros2`."""

from __future__ import annotations

from dataclasses import replace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed (make ros2 installs it beside)")

import numpy as np
import roslibpy
from sensor_msgs.msg import Image
from sgc.fleets import topic
from sgc.proxies.ros_ends import IMAGE, STRING, until
from sgc.proxies.test_ros2 import BOTH, CHAT, IN, OUT, chat, counts, joined, proxy
from std_msgs.msg import String
from test_msgs.msg import Arrays, MultiNested, UnboundedSequences, WStrings

from tutelage.sgc.commands.proxy import topics
from tutelage.sgc.proxies.ros_qos import PROFILES
from tutelage.sgc.proxies.ros_types import RosTypes
from tutelage.sgc.proxies.rosbridge import Bridge
from tutelage.sgc.proxies.routes import all_routes

SENSOR = {"depth": 5, "reliability": "BEST_EFFORT"}
LATCHED = {"depth": 2, "durability": "TRANSIENT_LOCAL"}


def texts(node, count=0, name="/chatter"):
    return [message.data for message in node.heard(name, count)]


def say(node, *words, name="/chatter"):
    node.publish(name, [String(data=word) for word in words])


def found(node, subscriptions, name="/chatter"):
    """Has the node's publisher found so many subscriptions?"""
    return until(lambda: node.subscribers(name) == subscriptions, 20.0)


def listening(node, publishers, name="/chatter"):
    """Has the node's subscription found so many publishers?"""
    return until(lambda: node.hears(name) == publishers, 20.0)


def test_300_messages_cross_each_way_in_order_and_nothing_goes_round(company, ros_domains, ros_nodes):
    here, there = next(ros_domains), next(ros_domains)
    robot, server = company(CHAT, "robot", "server")
    with proxy(robot, chat(here)) as one, proxy(server, chat(there)) as other:
        a, b = ros_nodes(here, "a"), ros_nodes(there, "b")
        for node in (a, b):
            node.subscribe("/chatter", String)
            node.advertise("/chatter", String)
            assert found(node, 2)  # its own, and the proxy's
            assert listening(node, 2)
        assert joined(one, other)
        said = [f"message {i}" for i in range(300)]
        say(a, *said)
        assert texts(b, 300) == said
        say(b, *said)
        assert texts(a, 600)[300:] == said
        say(a, "last")
        assert texts(b, 601)[300:] == [*said, "last"]
        assert (counts(one)["out"], counts(one)["in"]) == (301, 300)
        assert (counts(other)["out"], counts(other)["in"]) == (300, 301)


def test_an_image_of_6_mb_arrives_byte_for_byte(company, ros_domains, ros_nodes):
    here, there = next(ros_domains), next(ros_domains)
    robot, server = company(topic("chat", ["robot"], ["server"], type=IMAGE), "robot", "server")
    pixels = np.random.default_rng(0).integers(0, 256, 1080 * 1920 * 3, np.uint8)
    sent = Image(height=1080, width=1920, encoding="rgb8", step=5760)
    sent.header.frame_id = "camera"
    sent.data = pixels.tobytes()
    with proxy(robot, chat(here, type_name=IMAGE, **OUT)) as out, proxy(server, chat(there, type_name=IMAGE, **IN)) as into:
        a, b = ros_nodes(here, "a"), ros_nodes(there, "b")
        b.subscribe("/chatter", Image)
        a.advertise("/chatter", Image)
        assert found(a, 1)
        assert joined(out, into)

        def begun():  # the first one may be lost, see the documentation
            a.publish("/chatter", [sent])
            return b.heard("/chatter", 1, 2.0)

        assert until(begun)
        had = len(b.heard("/chatter", 2, 0.5))
        a.publish("/chatter", [sent] * 3)
        assert b.heard("/chatter", had + 3) == [sent] * (had + 3)


def unusual():
    """Messages with everything that the language of ROS 2's definitions has."""
    sequences = UnboundedSequences(
        bool_values=[True, False], int64_values=[-(2**63)], string_values=["", "Grüße"], alignment_check=7
    )
    wide = WStrings(wstring_value="日本", array_of_wstrings=["a", "", "ß"])
    nested = MultiNested(unbounded_sequence_of_arrays=[Arrays(alignment_check=1)] * 5)
    return [sequences, wide, nested, MultiNested()]


@pytest.mark.parametrize("message", unusual(), ids=lambda message: type(message).__name__)
def test_types_of_any_kind_pass_unchanged(company, ros_domains, ros_nodes, message):
    here, there = next(ros_domains), next(ros_domains)
    robot, server = company(CHAT, "robot", "server")
    kind = f"test_msgs/msg/{type(message).__name__}"
    with proxy(robot, chat(here, type_name=kind, **OUT)) as out, proxy(server, chat(there, type_name=kind, **IN)) as into:
        a, b = ros_nodes(here, "a"), ros_nodes(there, "b")
        b.subscribe("/chatter", type(message))
        a.advertise("/chatter", type(message))
        assert found(a, 1)
        assert listening(b, 1)
        assert joined(out, into)
        a.publish("/chatter", [message])
        assert b.heard("/chatter", 1) == [message]


def test_sensors_that_publish_best_effort_flow(company, ros_domains, ros_nodes):
    here, there = next(ros_domains), next(ros_domains)
    robot, server = company(topic("chat", ["robot"], ["server"], delivery="lossy"), "robot", "server")
    sensor = PROFILES["sensor_data"]
    with proxy(robot, chat(here, qos=sensor, **OUT)), proxy(server, chat(there, qos=sensor, **IN)):
        a, b = ros_nodes(here, "a"), ros_nodes(there, "b")
        b.subscribe("/chatter", String, **SENSOR)
        b.subscribe("/chatter", String)  # reliable: it asks for more than is offered
        a.advertise("/chatter", String, **SENSOR)
        assert found(a, 1)

        def flows():
            say(a, "again")
            return len(b.heard("/chatter")) > 3

        assert until(flows)
        (publisher,) = b.publishers("/chatter")
        assert publisher["reliability"] == "best_effort"


def test_a_latched_map_reaches_who_subscribes_late(company, ros_domains, ros_nodes):
    here, there = next(ros_domains), next(ros_domains)
    robot, server = company(topic("map", ["robot"], ["server"]), "robot", "server")
    route = {"alias": "map", "name": "/map", "qos": replace(PROFILES["latched"], depth=2)}
    a = ros_nodes(here, "a")
    a.advertise("/map", String, **LATCHED)
    say(a, "oldest", "old", "new", name="/map")  # before there is a proxy
    with proxy(robot, chat(here, **route, **OUT)), proxy(server, chat(there, **route, **IN)) as into:
        assert until(lambda: counts(into, "map")["in"] == 2, 20.0)
        late = ros_nodes(there, "late")
        late.subscribe("/map", String, **LATCHED)
        assert texts(late, 2, "/map") == ["old", "new"]
        say(a, "newest", name="/map")
        assert texts(late, 3, "/map") == ["old", "new", "newest"]


def test_qualities_of_service_that_do_not_fit_are_told(company, ros_domains, ros_nodes, caplog):
    here = next(ros_domains)
    robot, _ = company(CHAT, "robot", "server")
    a = ros_nodes(here, "a")
    a.advertise("/chatter", String, **SENSOR)
    with proxy(robot, chat(here, **OUT)):
        assert until(lambda: "/chatter on domain" in caplog.text)
        assert "do not fit the route's qos (reliability)" in caplog.text
        assert a.subscribers("/chatter") == 0


def test_ros_2_sees_type_hash_and_quality_of_what_a_proxy_publishes(company, ros_domains, ros_nodes):
    here = next(ros_domains)
    robot, _ = company(topic("chat", ["server"], ["robot"], type=IMAGE), "robot", "server")
    node = ros_nodes(here, "node")
    node.advertise("/own_image", Image)
    route = chat(here, name="/from_fleet", type_name=IMAGE, qos=PROFILES["latched"], **IN)
    with proxy(robot, route, distribution="jazzy"):
        (seen,) = until(lambda: node.publishers("/from_fleet"))
        (own,) = node.publishers("/own_image")
        assert node.topics()["/from_fleet"] == [IMAGE]
        assert (seen["type"], seen["hash"]) == (own["type"], own["hash"])
        assert (seen["reliability"], seen["durability"]) == ("reliable", "transient_local")
        assert seen["node"] == "_CREATED_BY_BARE_DDS_APP_", "it is of no node"
    assert until(lambda: not node.publishers("/from_fleet"), 20.0), "the lease is over"


def test_what_is_on_a_domain_can_be_listed(ros_domains, ros_nodes, capsys):
    from std_srvs.srv import SetBool

    here = next(ros_domains)
    node = ros_nodes(here, "node")
    node.advertise("/chatter", String, **SENSOR)
    node.subscribe("/image", Image)
    node.serve("/set", SetBool)
    topics(here, 2.0)
    listed = capsys.readouterr().out.splitlines()
    assert f"topic  /chatter  {STRING}  1 / 0 publishers, subscriptions  best_effort  volatile" in listed
    assert f"topic  /image  {IMAGE}  0 / 1 publishers, subscriptions" in listed
    assert "service  /set  std_srvs/srv/SetBool  0 / 1 clients, servers" in listed


def test_a_web_page_talks_with_a_ros_2_node(company, ros_domains, ros_nodes):
    here = next(ros_domains)
    robot, server = company(CHAT, "robot", "server")
    with (
        proxy(robot, chat(here, **BOTH)) as ros2,
        Bridge(server, all_routes(server.access), RosTypes("jazzy"), port=0) as bridge,
    ):
        node = ros_nodes(here, "node")
        node.subscribe("/chatter", String)
        node.advertise("/chatter", String)
        page = roslibpy.Ros(*bridge.address)
        page.run(timeout=10)
        heard: list[str] = []
        roslibpy.Topic(page, "/chat", "std_msgs/String").subscribe(lambda message: heard.append(message["data"]))
        assert found(node, 2)
        assert listening(node, 2)
        assert joined(ros2)
        talker = roslibpy.Topic(page, "/chat", "std_msgs/String")
        talker.publish(roslibpy.Message({"data": "from the page"}))
        assert texts(node, 1) == ["from the page"]

        def answered():
            say(node, "from the node")
            return until(lambda: "from the node" in heard, 0.2)

        assert until(answered)
        assert counts(ros2)["in"] == 1, "nothing comes back to where it is from"
        page.close()
