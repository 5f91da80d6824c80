"""ROS 2 domains joined through nodes of the fleet, in one process."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import Policy
from sgc.fleets import topic
from sgc.proxies.ros_ends import (
    BEST_EFFORT,
    IMAGE,
    LATCHED,
    STRING,
    RosNode,
    String,
    cdr,
    taken,
    until,
)

from tutelage.errors import ConfigError
from tutelage.sgc.proxies import dds_raw
from tutelage.sgc.proxies.dds_qos import parse_user_data
from tutelage.sgc.proxies.ros2 import Ros2Proxy
from tutelage.sgc.proxies.ros_qos import PROFILES
from tutelage.sgc.proxies.ros_topics import Inward, Outward
from tutelage.sgc.proxies.routes import Routes, TopicRoute

CHAT = topic("chat", ["robot", "server"], ["robot", "server"])
BOTH = {"outward": True, "inward": True}
OUT, IN = {"outward": True, "inward": False}, {"outward": False, "inward": True}
DEEP = replace(PROFILES["default"], depth=400)


def chat(domain, *, name="/chatter", qos=DEEP, alias="chat", type_name=STRING, **ways):
    return TopicRoute(alias, name, type_name, **(ways or BOTH), qos=qos, domain=domain, queue=400)


def proxy(node, *routes, distribution=""):
    return Ros2Proxy(node, Routes(tuple(routes), (), distribution))


def counts(proxy, alias="chat"):
    return proxy.counters()["topics"][alias]


def joined(*proxies):
    """Has each topic of these proxies found one end of a node on its domain?"""
    parts = [part for proxy in proxies for part in proxy._parts]
    ends = [part._writer for part in parts if isinstance(part, Inward)]
    ends += [part._reader for part in parts if isinstance(part, Outward)]
    return until(lambda: all(end.matched == 1 for end in ends), 20.0)


def test_300_messages_cross_in_order_and_each_once(company, domains):
    here, there = next(domains), next(domains)
    robot, server = company(CHAT, "robot", "server")
    with proxy(robot, chat(here)) as out, proxy(server, chat(there)) as into:
        listener = RosNode(there).subscription("/chatter")
        assert until(listener.get_matched_publications)
        texts = [f"message {i}" for i in range(300)]
        RosNode(here).say("/chatter", texts)
        assert taken(listener, 300) == texts
        assert counts(out)["out"] == counts(into)["in"] == 300


def test_both_directions_and_nothing_goes_round(company, domains):
    here, there = next(domains), next(domains)
    robot, server = company(CHAT, "robot", "server")
    with proxy(robot, chat(here)) as one, proxy(server, chat(there)) as other:
        a, b = RosNode(here), RosNode(there)
        hears_a, hears_b = a.subscription("/chatter"), b.subscription("/chatter")
        assert until(hears_a.get_matched_publications)
        assert until(hears_b.get_matched_publications)
        a.say("/chatter", ["from a"])
        assert taken(hears_b, 1) == ["from a"]
        b.say("/chatter", ["from b"])
        assert set(taken(hears_a, 2)) == {"from a", "from b"}
        time.sleep(0.3)
        assert taken(hears_a, 1, 0.1) == []
        assert taken(hears_b, 2, 0.1) == ["from b"]
        assert (counts(one)["out"], counts(one)["in"]) == (counts(other)["out"], counts(other)["in"]) == (1, 1)


def test_two_proxies_on_one_domain_do_not_feed_each_other(company, domains):
    here, there = next(domains), next(domains)
    policy = topic("chat", ["robot", "server", "spare"], ["robot", "server", "spare"])
    robot, server, spare = company(policy, "robot", "server", "spare")
    with proxy(robot, chat(here)), proxy(server, chat(there)) as one, proxy(spare, chat(there)) as other:
        listener = RosNode(there).subscription("/chatter")
        assert until(lambda: len(listener.get_matched_publications()) == 2)
        RosNode(here).say("/chatter", ["once"])
        assert taken(listener, 2) == ["once", "once"]  # both bring it: one proxy a domain and topic is enough
        time.sleep(0.5)
        assert taken(listener, 1, 0.1) == []
        assert counts(one)["out"] == counts(other)["out"] == 0
        assert counts(one)["from_proxies"] + counts(other)["from_proxies"] == 2


def test_what_is_not_listed_stays_on_its_domain(company, domains):
    here, there = next(domains), next(domains)
    robot, server = company(CHAT, "robot", "server")
    with proxy(robot, chat(here, **OUT)), proxy(server, chat(there, **IN)):
        a, b = RosNode(here), RosNode(there)
        listener = b.subscription("/chatter")
        secret = b.subscription("/secret")
        assert until(listener.get_matched_publications)
        said = a.publisher("/secret")
        said.write(String("private"))
        a.say("/chatter", ["public"])
        assert taken(listener, 1) == ["public"]
        assert not secret.get_matched_publications()
        assert not said.get_matched_subscriptions()
        b.publisher("/chatter").write(String("the other way is not listed"))
        assert taken(a.subscription("/chatter"), 1, 0.5) == []


def test_topics_of_several_robots_meet_on_one_name(company, domains):
    """Section 8.3: disjoint robots may publish to the same local topic."""
    one, two, there = (next(domains) for _ in range(3))
    policy = topic("chat-1", ["robot"], ["server"]) + topic("chat-2", ["other"], ["server"])
    robot, other, server = company(policy, "robot", "other", "server")
    with (
        proxy(robot, chat(one, alias="chat-1", **OUT)),
        proxy(other, chat(two, alias="chat-2", **OUT)),
        proxy(server, chat(there, alias="chat-1", **IN), chat(there, alias="chat-2", **IN)),
    ):
        listener = RosNode(there).subscription("/chatter")
        assert until(lambda: len(listener.get_matched_publications()) == 2)
        RosNode(one).say("/chatter", ["one"])
        RosNode(two).say("/chatter", ["two"])
        assert sorted(taken(listener, 2)) == ["one", "two"]


def test_one_process_carries_several_domains_and_joins_those_of_one_topic(company, domains):
    first, second, there = (next(domains) for _ in range(3))
    robot, server = company(CHAT, "robot", "server")
    with proxy(robot, chat(first), chat(second, name="/second")) as both, proxy(server, chat(there)):
        near, far = RosNode(second).subscription("/second"), RosNode(there).subscription("/chatter")
        assert until(near.get_matched_publications)
        assert until(far.get_matched_publications)
        RosNode(first).say("/chatter", ["everywhere"])
        assert taken(near, 1) == taken(far, 1) == ["everywhere"]
        time.sleep(0.3)
        assert counts(both)["out"] == 1
        assert taken(near, 1, 0.1) == []


def test_any_type_passes_unchanged_also_14_mb(company, domains):
    here, there = next(domains), next(domains)
    robot, server = company(topic("chat", ["robot"], ["server"], type=IMAGE), "robot", "server")
    with proxy(robot, chat(here, type_name=IMAGE, **OUT)), proxy(server, chat(there, type_name=IMAGE, **IN)):
        reader = RosNode(there).raw_subscription("/chatter", IMAGE)
        writer = RosNode(here).raw_publisher("/chatter", IMAGE)
        assert until(reader.get_matched_publications)
        assert until(writer.get_matched_subscriptions)
        for size in (10, 14_000_001):
            sent = b"\0\1\0\0" + bytes(size)
            dds_raw.write(writer, sent)
            assert until(lambda: dds_raw.take(reader))[0].data == sent


def test_best_effort_and_lossy_topics_flow(company, domains):
    here, there = next(domains), next(domains)
    robot, server = company(topic("chat", ["robot"], ["server"], delivery="lossy"), "robot", "server")
    sensor = PROFILES["sensor_data"]
    with proxy(robot, chat(here, qos=sensor, **OUT)), proxy(server, chat(there, qos=sensor, **IN)):
        listener = RosNode(there).subscription("/chatter", qos=BEST_EFFORT)
        reliable = RosNode(there).subscription("/chatter")
        assert until(listener.get_matched_publications)
        writer = RosNode(here).say("/chatter", ["first"], qos=BEST_EFFORT)
        texts: list[str] = []

        def flows():
            writer.write(String("again"))
            texts.extend(taken(listener, 1, 0.05))
            return len(texts) > 3

        assert until(flows)
        assert not reliable.get_matched_publications(), "best effort is offered, so reliable is refused"


def test_qualities_of_service_that_do_not_fit_are_told(company, domains, caplog):
    here = next(domains)
    robot, _ = company(CHAT, "robot", "server")
    with proxy(robot, chat(here, **OUT)):
        node = RosNode(here)
        writer = node.publisher("/chatter", qos=BEST_EFFORT)
        assert until(lambda: "/chatter on domain" in caplog.text)
        assert "do not fit the route's qos (reliability)" in caplog.text
        assert not writer.get_matched_subscriptions()


def test_a_queue_that_overflows_drops_the_oldest_and_counts_them(company, domains):
    here = next(domains)
    robot, _ = company(CHAT, "robot", "server")
    small = TopicRoute("chat", "/chatter", STRING, True, False, qos=DEEP, domain=here, queue=4)
    with proxy(robot, small) as out:
        part = out._parts[0]
        part._send = lambda data: time.sleep(0.05)  # a slow network
        RosNode(here).say("/chatter", [str(i) for i in range(40)])
        assert until(lambda: counts(out)["out_dropped"] > 20)


def test_keep_all_holds_the_writer_back_instead_of_dropping(company, domains):
    here = next(domains)
    robot, _ = company(CHAT, "robot", "server")
    keep_all = replace(PROFILES["default"], history="keep_all")
    with proxy(robot, TopicRoute("chat", "/chatter", STRING, True, False, qos=keep_all, domain=here, queue=4)) as out:
        sent = []
        part = out._parts[0]
        part._send = lambda data: (time.sleep(0.005), sent.append(data))
        RosNode(here).say("/chatter", [str(i) for i in range(100)])
        assert until(lambda: len(sent) == 100)
        assert counts(out)["out_dropped"] == 0


def test_latched_messages_reach_late_subscribers_and_late_nodes_and_nobody_twice(company, domains):
    here, there, late = (next(domains) for _ in range(3))
    nodes = company(topic("map", ["robot"], ["server", "spare"]), "robot", "server", "spare")
    latched = {"alias": "map", "name": "/map", "qos": replace(PROFILES["latched"], depth=2)}
    with (
        proxy(nodes["robot"], chat(here, **latched, **OUT)) as out,
        proxy(nodes["server"], chat(there, **latched, **IN)) as into,
    ):
        early = RosNode(there).subscription("/map", qos=LATCHED)
        assert until(early.get_matched_publications)
        author = RosNode(here).say("/map", ["old", "older", "newer"], qos=LATCHED)
        assert taken(early, 3) == ["old", "older", "newer"]
        assert taken(RosNode(there).subscription("/map", qos=LATCHED), 2) == ["older", "newer"]
        with proxy(nodes["spare"], chat(late, **latched, **IN)) as newcomer:
            assert taken(RosNode(late).subscription("/map", qos=LATCHED), 2)[-2:] == ["older", "newer"]
            had = counts(newcomer, "map")["in"]
            repeated = out._parts[0].retained.repeated
            assert until(lambda: out._parts[0].retained.repeated > repeated)
            author.write(String("newest"))
            assert taken(early, 1) == ["newest"]
            assert until(lambda: counts(newcomer, "map")["in"] == had + 1)
            assert counts(into, "map")["in"] == 4


def test_a_message_that_is_none_is_not_written_on_a_domain(company, domains):
    there = next(domains)
    robot, server = company(CHAT, "robot", "server")
    with proxy(server, chat(there, **IN)) as into:
        listener = RosNode(there).subscription("/chatter")
        assert until(listener.get_matched_publications)
        publisher = robot.publisher("chat")
        for bad in (b"", b"\0\1\0\0", b"not cdr", b"\xff" * 100, b"\0\0\0\0\0\0\0\1a"):
            publisher.send(bad)
        publisher.send(cdr(STRING, data="good"))
        assert taken(listener, 1) == ["good"]
        assert counts(into)["not_cdr"] == 5


def test_type_hashes_and_marks_are_in_discovery_for_distributions_that_have_them(company, domains):
    newer, older = next(domains), next(domains)
    robot, _ = company(CHAT, "robot", "server")
    for domain, distribution, hashed in ((newer, "jazzy", True), (older, "humble", False)):
        with proxy(robot, chat(domain, **IN), distribution=distribution):
            looker = RosNode(domain)
            seen = BuiltinDataReader(looker.participant, BuiltinTopicDcpsPublication)
            found = until(lambda seen=seen: [e for e in seen.take(N=100) if getattr(e, "topic_name", "") == "rt/chatter"])
            data = parse_user_data(bytes(found[0].qos[Policy.Userdata].data))
            assert len(data["tutelage"]) == 32
            # The hash that `ros2 topic info -v` shows for std_msgs/msg/String.
            expected = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
            assert data.get("typehash") == (expected if hashed else None)


def test_a_domain_that_cannot_be_joined_is_one_line(company, domains, monkeypatch):
    robot, _ = company(CHAT, "robot", "server")
    monkeypatch.setenv("CYCLONEDDS_URI", "<CycloneDDS><Domain><Nonsense/></Domain></CycloneDDS>")
    with pytest.raises(ConfigError, match="cannot be joined"):
        proxy(robot, chat(next(domains)))


def test_a_closed_proxy_leaves_its_domains(company, domains):
    here = next(domains)
    robot, _ = company(CHAT, "robot", "server")
    writer = RosNode(here).publisher("/chatter")
    with proxy(robot, chat(here)):
        assert until(writer.get_matched_subscriptions)
    assert until(lambda: not writer.get_matched_subscriptions())


@pytest.mark.parametrize("data", ["", "a=1;b=2;", "a=1;=;;b", "\xff=;x=\x00;"])
def test_user_data_of_others_never_breaks_us(data):
    assert isinstance(parse_user_data(data.encode("latin-1")), dict)
