"""rosbridge on the fleet's topics, with plain WebSocket clients."""

from __future__ import annotations

import base64
import contextlib
import json
import socket
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from sgc.fleets import Fleet, service, topic
from sgc.proxies.company import Company
from sgc.proxies.ros_ends import ADD, STRING, cdr, until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from tutelage.errors import ConfigError
from tutelage.sgc.proxies.ros_types import RosTypes
from tutelage.sgc.proxies.rosbridge import Bridge
from tutelage.sgc.proxies.rosbridge_session import MAX_WISHES
from tutelage.sgc.proxies.routes import all_routes, parse_routes

TYPES = RosTypes("jazzy")
POLICY = (
    topic("chat", ["robot", "web"], ["robot", "web"], interface="/chatter")
    + topic("camera", ["robot"], ["web"], type="sensor_msgs/msg/Image")
    + topic("orders", ["web"], ["robot"])
    + topic("strange", ["robot"], ["web"], type="strange_msgs/msg/Thing")
    + service("add", ["robot"], ["web"], type=ADD)
    + service("page", ["web"], ["robot"], type="std_srvs/srv/SetBool")
)


class Page:
    """A client."""

    def __init__(self, address, path="", **options) -> None:
        settings = {"compression": None, "max_size": None, "close_timeout": 0.5, **options}
        self.socket = connect(f"ws://{address[0]}:{address[1]}/{path}", **settings).__enter__()

    def send(self, **message) -> None:
        self.socket.send(json.dumps(message))

    def receive(self, timeout=5.0):
        """The next message, None if there is none in that time."""
        try:
            frame = self.socket.recv(timeout=timeout)
        except TimeoutError:
            return None
        return json.loads(frame) if isinstance(frame, str) else frame

    def ask(self, **message):
        self.send(**message)
        return self.receive()


@pytest.fixture
def robot_and_bridge(company):
    robot, web = company(POLICY, "robot", "web")
    with Bridge(web, all_routes(web.access), TYPES, port=0) as bridge:
        yield robot, bridge


@pytest.fixture
def robot(robot_and_bridge):
    return robot_and_bridge[0]


@pytest.fixture
def bridge(robot_and_bridge):
    return robot_and_bridge[1]


@pytest.fixture(scope="module")
def patient_bridge(tmp_path_factory):
    """One for the tests that change nothing."""
    nodes = Company(Fleet(tmp_path_factory.mktemp("fleet"), POLICY, ["robot", "web"]))
    with Bridge(nodes["web"], all_routes(nodes["web"].access), TYPES, port=0) as bridge:
        yield bridge
    nodes.close()


@pytest.fixture
def page(bridge):
    page = Page(bridge.address)
    yield page
    page.socket.close()


def subscribe(page, name="/chatter", **fields):
    page.send(op="set_level", level="info")
    assert page.ask(op="subscribe", topic=name, **fields)["msg"] == f"subscribed to {name}"


def publish(node, alias, *texts):
    for text in texts:
        node.publisher(alias).send(cdr(STRING, data=text))


def test_what_a_client_publishes_reaches_the_fleet_and_what_the_fleet_publishes_the_client(robot, page):
    heard = []
    robot.subscribe("chat", heard.append)
    subscribe(page)
    page.send(op="advertise", topic="/chatter", type="std_msgs/String")
    assert page.receive()["level"] == "info"
    page.send(op="publish", topic="/chatter", msg={"data": "from the page"})
    assert page.receive() == {"op": "publish", "topic": "/chatter", "msg": {"data": "from the page"}}
    assert until(lambda: heard)
    assert heard[0].payload == cdr(STRING, data="from the page")
    publish(robot, "chat", "from the robot")
    assert page.receive()["msg"] == {"data": "from the robot"}


def test_1000_messages_arrive_in_order_at_each_client(robot, bridge):
    pages = [Page(bridge.address) for _ in range(3)]
    for page in pages:
        subscribe(page)
    texts = [str(i) for i in range(1000)]
    threading.Thread(target=publish, args=(robot, "chat", *texts)).start()
    for page in pages:
        assert [page.receive()["msg"]["data"] for _ in texts] == texts
        page.socket.close()


def test_a_subscription_ends_and_its_last_one_ends_the_fleets(robot, bridge, page):
    subscribe(page, id="one")
    assert page.ask(op="subscribe", topic="/chatter", id="two")["level"] == "info"
    publish(robot, "chat", "once")
    assert page.receive()["msg"] == {"data": "once"}, "two ids are one subscription"
    page.send(op="unsubscribe", topic="/chatter", id="one")
    publish(robot, "chat", "still")
    assert page.receive()["msg"] == {"data": "still"}
    page.send(op="unsubscribe", topic="/chatter")
    assert page.ask(op="unsubscribe", topic="/chatter")["level"] == "warning"
    publish(robot, "chat", "unheard")
    assert page.receive(0.3) is None
    assert bridge.topics["/chatter"]._subscription is None


def test_a_throttle_lets_through_one_message_an_interval(robot, page):
    subscribe(page, throttle_rate=100)
    for i in range(60):
        publish(robot, "chat", str(i))
        time.sleep(0.005)
    heard = []
    while (message := page.receive(0.3)) is not None:
        heard.append(int(message["msg"]["data"]))
    assert heard[0] == 0
    assert 2 <= len(heard) <= 15


def test_a_queue_keeps_the_newest_of_what_the_throttle_holds_back(robot, page):
    subscribe(page, throttle_rate=100, queue_length=3)
    publish(robot, "chat", *(str(i) for i in range(50)))
    heard = [page.receive(1.0)["msg"]["data"] for _ in range(4)]
    assert heard == ["0", "47", "48", "49"]


def test_large_messages_come_in_fragments_if_asked_for(robot, page):
    subscribe(page, fragment_size=100)
    publish(robot, "chat", "x" * 1000)
    first = page.receive()
    pieces = [first, *(page.receive() for _ in range(first["total"] - 1))]
    assert [piece["num"] for piece in pieces] == list(range(first["total"]))
    assert json.loads("".join(piece["data"] for piece in pieces))["msg"]["data"] == "x" * 1000


def test_messages_come_as_cbor_png_or_raw_if_asked_for(robot, bridge):
    cbor2 = pytest.importorskip("cbor2")
    image = {"height": 2, "width": 2, "step": 2, "encoding": "mono8", "data": "AAECAw=="}
    data = bridge.topics["/camera"].codec.serialize(image)
    pages = {kind: Page(bridge.address) for kind in ("cbor", "cbor-raw", "png", "none")}
    for kind, page in pages.items():
        subscribe(page, "/camera", compression=kind)
    robot.publisher("camera").send(data)
    got = {kind: page.receive() for kind, page in pages.items()}
    assert got["none"]["msg"]["data"] == "AAECAw=="
    assert got["png"]["op"] == "png"
    assert base64.b64decode(got["png"]["data"]).startswith(b"\x89PNG")
    assert cbor2.loads(got["cbor"])["msg"]["data"] == b"\0\1\2\3"
    raw = cbor2.loads(got["cbor-raw"])
    assert (raw["op"], raw["topic"], raw["msg"]["bytes"]) == ("publish", "/camera", data)
    assert abs(raw["msg"]["secs"] - time.time()) < 60


def test_a_type_without_definition_still_comes_raw(robot, page):
    cbor2 = pytest.importorskip("cbor2")
    status = page.ask(op="subscribe", topic="/strange", id=5)
    assert (status["level"], status["id"]) == ("error", 5)
    assert "strange_msgs/msg/Thing is not known" in status["msg"]
    subscribe(page, "/strange", compression="cbor-raw")
    robot.publisher("strange").send(b"\0\1\0\0abcd")
    assert cbor2.loads(page.receive())["msg"]["bytes"] == b"\0\1\0\0abcd"


def test_latched_messages_come_to_pages_that_open_late(company):
    robot, web = company(topic("map", ["robot"], ["web"]), "robot", "web")
    routes = parse_routes({"version": 1, "topic": [{"alias": "map", "qos": {"profile": "latched", "depth": 2}}]}, web.access)
    with Bridge(web, routes, TYPES, port=0) as bridge:
        publish(robot, "map", "old", "newer", "newest")
        assert until(lambda: bridge.counters()["topics"]["map"]["received"] == 3)
        late = Page(bridge.address)
        late.send(op="subscribe", topic="/map")
        assert [late.receive()["msg"]["data"] for _ in range(2)] == ["newer", "newest"]
        late.socket.close()


def test_a_client_calls_a_service_of_the_fleet(robot, page):
    asks, answers = (TYPES.need(f"{ADD}_{part}") for part in ("Request", "Response"))
    from tutelage.sgc.proxies.ros_values import Codec

    def add(message):
        values = Codec(TYPES, asks).values(message.payload)
        if values["a"] < 0:
            raise ValueError("negative numbers are not for us")
        return Codec(TYPES, answers).serialize({"sum": values["a"] + values["b"]})

    robot.serve("add", add)
    expected = {"op": "service_response", "id": "x", "service": "/add", "result": True, "values": {"sum": 5}}
    assert page.ask(op="call_service", service="/add", id="x", args={"a": 2, "b": 3}) == expected
    assert page.ask(op="call_service", service="add", id="x", args=[2, 3])["values"] == {"sum": 5}
    failed = page.ask(op="call_service", service="/add", args={"a": -1})
    assert failed["result"] is False
    assert "negative numbers" in failed["values"]
    assert "has no field 'c'" in page.ask(op="call_service", service="/add", args={"c": 1})["values"]
    assert "must be an object" in page.ask(op="call_service", service="/add", args=[1, 2, 3])["values"]


def test_without_a_server_the_call_fails_in_time(page):
    reply = page.ask(op="call_service", service="/add", args={}, timeout=0.3)
    assert reply["result"] is False


def test_a_client_answers_for_a_service(robot, bridge, page):
    page.send(op="advertise_service", service="/page", type="std_srvs/SetBool")
    assert until(lambda: bridge.services["/page"].provider)

    def answer():
        call = page.receive()
        assert (call["op"], call["args"]) == ("call_service", {"data": True})
        page.send(
            op="service_response", service="/page", id=call["id"], values={"success": True, "message": "on"}, result=True
        )

    requests, responses = TYPES.need_service("std_srvs/srv/SetBool")
    from tutelage.sgc.proxies.ros_values import Codec

    request = Codec(TYPES, requests).serialize({"data": True})
    thread = threading.Thread(target=answer)
    thread.start()
    assert Codec(TYPES, responses).values(robot.request("page", request)) == {"success": True, "message": "on"}
    thread.join()
    other = Page(bridge.address)
    assert "another client answers" in other.ask(op="advertise_service", service="/page", type="std_srvs/srv/SetBool")["msg"]
    other.socket.close()

    def refuse():
        page.send(op="service_response", service="/page", id=page.receive()["id"], values="not now", result=False)

    thread = threading.Thread(target=refuse)
    thread.start()
    with pytest.raises(Exception, match="not now"):
        robot.request("page", request)
    thread.join()
    page.socket.close()
    assert until(lambda: bridge.services["/page"].provider is None)


def test_a_client_that_leaves_fails_the_request_it_was_to_answer(robot, bridge, page):
    page.send(op="advertise_service", service="/page", type="std_srvs/SetBool")
    assert until(lambda: bridge.services["/page"].provider)

    def leave():
        page.receive()
        page.socket.close()

    threading.Thread(target=leave).start()
    with pytest.raises(Exception, match="nobody answers for /page any more"):
        robot.request("page", b"\0\1\0\0\1", timeout=5.0)


def test_clients_look_around_by_rosapi(page):
    def ask(name, **args):
        return page.ask(op="call_service", service=f"/rosapi/{name}", args=args)["values"]

    assert sorted(ask("topics")["topics"]) == ["/camera", "/chatter", "/orders", "/strange"]
    assert ask("topic_type", topic="/camera") == {"type": "sensor_msgs/msg/Image"}
    assert ask("topics_for_type", type=STRING) == {"topics": ["/chatter", "/orders"]}
    assert sorted(ask("services")["services"]) == ["/add", "/page"]
    assert ask("service_type", service="/add") == {"type": ADD}
    assert ask("get_ros_version")["version"] == 2
    assert "is not offered" in ask("nodes")


def test_the_policy_holds_for_clients(robot, page):
    assert "may not publish on /camera" in page.ask(op="publish", topic="/camera", msg={})["msg"]
    assert "may not subscribe to /orders" in page.ask(op="subscribe", topic="/orders")["msg"]
    assert "may not answer for /add" in page.ask(op="advertise_service", service="/add", type=ADD)["msg"]
    assert "there is no topic /secret here" in page.ask(op="subscribe", topic="/secret")["msg"]


@pytest.mark.parametrize(
    ("frame", "says"),
    [
        ("", "not JSON"),
        ("{", "not JSON"),
        ("[" * 100_000, "not JSON"),
        ("1" * 5000, "not JSON"),
        ("[]", 'a message is an object with "op"'),
        ("{}", 'a message is an object with "op"'),
        ('{"op": 5}', 'a message is an object with "op"'),
        ('{"op": "dance"}', "unknown operation 'dance'"),
        ('{"op": "send_action_goal"}', "unknown operation 'send_action_goal'"),
        (b"\x01\x02", "binary frames"),
        ('{"op": "publish"}', "publish needs topic, a text"),
        ('{"op": "publish", "topic": 5}', "publish needs topic, a text"),
        ('{"op": "publish", "topic": "a b"}', "is not a ROS 2 name"),
        ('{"op": "publish", "topic": "/orders", "msg": 5}', "must be an object, not 5"),
        ('{"op": "publish", "topic": "/orders", "msg": {"data": 5}}', "data must be text, not 5"),
        ('{"op": "publish", "topic": "/orders", "msg": {"data": "\\ud800"}}', "surrogates not allowed"),
        (
            '{"op": "advertise", "topic": "/orders", "type": "std_msgs/Int32"}',
            "is of type std_msgs/msg/String, not std_msgs/Int32",
        ),
        ('{"op": "advertise", "topic": "/orders"}', "advertise needs type"),
        ('{"op": "subscribe", "topic": "/chatter", "throttle_rate": -1}', "throttle_rate must be a number from 0"),
        ('{"op": "subscribe", "topic": "/chatter", "throttle_rate": "x"}', "throttle_rate must be a number"),
        ('{"op": "subscribe", "topic": "/chatter", "queue_length": 1e99}', "queue_length must be a number"),
        ('{"op": "subscribe", "topic": "/chatter", "queue_length": NaN}', "queue_length must be a number"),
        ('{"op": "subscribe", "topic": "/chatter", "compression": "zip"}', "compression must be one of"),
        ('{"op": "subscribe", "topic": "/chatter", "compression": ["cbor"]}', "compression must be one of"),
        ('{"op": "call_service", "service": 5}', "call_service needs service"),
        ('{"op": "service_response", "service": "/page", "id": "x"}', "not answered for by this client"),
        ('{"op": "fragment"}', "a fragment needs"),
        ('{"op": "fragment", "id": "a", "data": "{", "num": 0, "total": 1}', "not JSON"),
        (
            '{"op": "fragment", "id": "a", "data": "{\\"op\\":\\"fragment\\"}", "num": 0, "total": 1}',
            "fragments within fragments",
        ),
        ('{"op": "set_level", "level": "loud"}', "level must be one of"),
        ('{"op": "set_level", "level": {}}', "level must be one of"),
    ],
)
def test_what_cannot_be_obeyed_is_answered_by_a_status_message(patient_bridge, frame, says):
    page = Page(patient_bridge.address)
    page.socket.send(frame)
    reply = page.receive()
    assert says in (reply["msg"] if reply["op"] == "status" else reply["values"])
    assert page.ask(op="call_service", service="/rosapi/topics")["result"] is True, "the client is still served"
    page.socket.close()


def test_fragments_of_a_client_are_put_together(robot, page):
    heard = []
    robot.subscribe("orders", heard.append)
    text = json.dumps({"op": "publish", "topic": "/orders", "msg": {"data": "in pieces"}})
    for num, at in enumerate(range(0, len(text), 10)):
        page.send(op="fragment", id="f", data=text[at : at + 10], num=num, total=-(-len(text) // 10))
    assert until(lambda: heard)
    assert heard[0].payload == cdr(STRING, data="in pieces")


def test_10000_damaged_frames_leave_the_bridge_alive(bridge):
    rng = np.random.Generator(np.random.PCG64(0))
    seeds = [
        '{"op": "publish", "topic": "/orders", "msg": {"data": "hello"}, "id": 5}',
        '{"op": "subscribe", "topic": "/chatter", "throttle_rate": 5, "queue_length": 2, "fragment_size": 100}',
        '{"op": "call_service", "service": "/rosapi/topics", "args": [1, {"a": null}], "id": "x"}',
        '{"op": "fragment", "id": "a", "data": "[1, 2", "num": 0, "total": 2}',
        '{"op": "service_response", "service": "/page", "id": "a", "values": {}, "result": true}',
        '{"op": "unsubscribe", "topic": "/chatter"}',
    ]
    sent = 0
    while sent < 10_000:
        page = Page(bridge.address)
        reader = threading.Thread(target=lambda page=page: [None for _ in page.socket], daemon=True)
        reader.start()
        for _ in range(1000):
            data = bytearray(seeds[rng.integers(len(seeds))], "ascii")
            for _ in range(rng.integers(0, 4)):
                data[rng.integers(len(data))] = rng.integers(32, 127)
            cut = data[: rng.integers(len(data) + 1)] if rng.random() < 0.2 else data
            page.socket.send(cut.decode() if rng.random() < 0.95 else bytes(cut))
            sent += 1
        page.socket.close()
    page = Page(bridge.address)
    assert page.ask(op="call_service", service="/rosapi/topics")["result"] is True
    assert bridge.counts.as_dict()["refused"] > 1000
    page.socket.close()


def test_a_frame_that_is_too_large_ends_only_that_client(company):
    _, web = company(POLICY, "robot", "web")
    with Bridge(web, all_routes(web.access), TYPES, port=0, max_message=10_000) as bridge:
        page, other = Page(bridge.address), Page(bridge.address)
        page.send(op="publish", topic="/orders", msg={"data": "x" * 20_000})
        with pytest.raises(ConnectionClosed):
            page.receive()
        assert other.ask(op="call_service", service="/rosapi/topics")["result"] is True
        other.socket.close()


def test_a_client_that_does_not_read_costs_bounded_memory_and_nobody_elses_messages(robot, bridge):
    lazy, keen = Page(bridge.address, max_queue=1), Page(bridge.address)
    for page in (lazy, keen):
        page.send(op="set_level", level="none")
        page.send(op="subscribe", topic="/chatter")
    assert until(lambda: len(bridge.topics["/chatter"]._listeners) == 2)
    big, count = "x" * 200_000, 200
    threading.Thread(target=publish, args=(robot, "chat", *[big] * count)).start()
    for _ in range(count):
        assert keen.receive()["msg"]["data"] == big
    lazy.socket.close()
    keen.socket.close()
    assert until(lambda: bridge.counts.as_dict()["dropped"] > 0)


def test_a_client_that_asks_and_never_reads_is_disconnected(bridge):
    narrow = socket.socket()
    narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    narrow.connect(bridge.address)
    page = Page(bridge.address, max_queue=1, ping_interval=None, sock=narrow)

    def ask():
        with contextlib.suppress(ConnectionClosed):
            for _ in range(100_000):
                page.socket.send('{"op": "' + "x" * 2000 + '"}')

    asking = threading.Thread(target=ask)
    asking.start()
    assert until(lambda: bridge.counts.as_dict()["too_slow"] == 1, 30.0)
    assert until(lambda: bridge.counters()["connected"] == 0)
    page.socket.socket.close()
    asking.join(10.0)


def test_subscriptions_of_one_client_are_bounded(page):
    for i in range(MAX_WISHES):
        page.send(op="subscribe", topic="/chatter", id=i)
    assert f"more than {MAX_WISHES} subscriptions" in page.ask(op="subscribe", topic="/chatter", id="more")["msg"]


@contextmanager
def guarded(company, **options):
    _, web = company(POLICY, "robot", "web")
    with Bridge(web, all_routes(web.access), TYPES, port=0, **options) as bridge:
        yield bridge.address


TOKEN = "0123456789abcdef"


def test_a_token_lets_in_by_header_or_query(company):
    with guarded(company, token=TOKEN) as address:
        for options in (
            {},
            {"additional_headers": {"Authorization": "Bearer wrong"}},
            {"path": "?token="},
            {"path": "?token=x"},
        ):
            with pytest.raises(InvalidStatus, match="401"):
                Page(address, **options)
        Page(address, additional_headers={"Authorization": f"Bearer {TOKEN}"}).socket.close()
        Page(address, path=f"?token={TOKEN}").socket.close()


@pytest.mark.parametrize(
    ("origin", "comes_in"),
    [
        (None, True),
        ("http://localhost:8000", True),
        ("http://127.0.0.1", True),
        ("http://[::1]:5", True),
        ("https://operators.example", True),
        ("https://evil.example", False),
        ("http://localhost.evil.example", False),
        ("http://127.0.0.1.evil.example", False),
        ("null", False),
        ("http://[", False),
    ],
)
def test_pages_of_strangers_are_turned_away(company, origin, comes_in):
    with guarded(company, origins=["https://operators.example"]) as address:
        if comes_in:
            Page(address, origin=origin).socket.close()
        else:
            with pytest.raises(InvalidStatus, match="403"):
                Page(address, origin=origin)


def test_off_loopback_it_wants_protection_and_a_taken_port_is_an_error(company, bridge):
    _, web = company(POLICY, "robot", "web")
    with pytest.raises(ConfigError, match="needs TLS"):
        Bridge(web, all_routes(web.access), TYPES, host="0.0.0.0", token=TOKEN)
    with pytest.raises(ConfigError, match="cannot listen on 127.0.0.1"):
        Bridge(web, all_routes(web.access), TYPES, port=bridge.address[1])
