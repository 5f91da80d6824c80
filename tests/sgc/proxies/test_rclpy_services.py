"""Services and actions of unchanged ROS 2 nodes (rclpy, under the middleware that is installed): `make ros2`."""

from __future__ import annotations

import random
from concurrent.futures import ThreadPoolExecutor

import pytest

from tutelage.errors import ConfigError
from tutelage.sgc.proxies.ros2 import Ros2Proxy
from tutelage.sgc.proxies.routes import Routes, ServiceRoute, parse_routes

pytest.importorskip("rclpy", reason="ROS 2 is not installed (make ros2 installs it beside)")

from action_msgs.msg import GoalStatus
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.serialization import deserialize_message, serialize_message
from sgc.fleets import service, topic
from sgc.proxies.ros_ends import ADD, until
from sgc.proxies.test_ros2 import joined
from sgc.proxies.test_ros_services import RawService, counts
from std_srvs.srv import SetBool
from test_msgs.srv import Arrays, BasicTypes

from tutelage.sgc.proxies import dds_raw
from tutelage.sgc.service import RequestFailed

ECHO, SET = "test_msgs/srv/BasicTypes", "std_srvs/srv/SetBool"
SERVED = service("add", ["robot"], ["server", "console"])


def route(domain, *, out, type_name=SET, name="/set", timeout=10.0, through="rclpy", alias="add"):
    return Routes((), (ServiceRoute(alias, name, type_name, out, timeout, domain=domain, through=through),))


def test_a_client_on_one_domain_is_answered_by_a_server_on_another(company, ros_domains, ros_nodes):
    here, there = next(ros_domains), next(ros_domains)
    robot, server, _ = company(SERVED, "robot", "server", "console")
    a, b = ros_nodes(here, "a"), ros_nodes(there, "b")
    a.serve("/set", SetBool, success=True, message="done")
    with Ros2Proxy(robot, route(here, out=True)) as out, Ros2Proxy(server, route(there, out=False)) as into:
        reply = b.call("/set", SetBool, SetBool.Request(data=True))
        assert reply == SetBool.Response(success=True, message="done")
        assert a.asked("/set") == [SetBool.Request(data=True)]
        assert counts(out)["replies"] == counts(into)["replies"] == 1


def test_each_of_many_calls_at_a_time_gets_its_own_reply(company, ros_domains, ros_nodes):
    """Two clients of one domain, and one of the server's own domain, with eight calls each under way."""
    here, there = next(ros_domains), next(ros_domains)
    robot, server, _ = company(SERVED, "robot", "server", "console")
    a, b, c, near = ros_nodes(here, "a"), ros_nodes(there, "b"), ros_nodes(there, "c"), ros_nodes(here, "near")
    a.serve("/echo", BasicTypes, delay=0.02)
    echo = {"type_name": ECHO, "name": "/echo"}
    with (
        Ros2Proxy(robot, route(here, out=True, **echo)) as out,
        Ros2Proxy(server, route(there, out=False, **echo)),
        ThreadPoolExecutor(24) as pool,
    ):

        def ask(client, number):
            request = BasicTypes.Request(int64_value=number, string_value=f"call {number}")
            return client.call("/echo", BasicTypes, request, 20.0).string_value

        calls = [(client, i) for i in range(40) for client in (b, c, near)]
        assert list(pool.map(lambda call: ask(*call), calls)) == [f"call {i}" for _, i in calls]
        assert counts(out)["replies"] == 80


def test_a_program_of_the_fleet_is_told_what_went_wrong(company, ros_domains, ros_nodes):
    here = next(ros_domains)
    robot, _, console = company(SERVED, "robot", "server", "console")
    question = serialize_message(SetBool.Request(data=True))
    with Ros2Proxy(robot, route(here, out=True, timeout=0.5)) as out:
        with pytest.raises(RequestFailed, match=f"there is no ROS 2 server of /set on domain {here}"):
            console.request("add", question, timeout=5.0)
        node = ros_nodes(here, "slow")
        node.serve("/set", SetBool, delay=1.0)
        (part,) = out._parts
        assert until(part._end._client.service_is_ready)
        with pytest.raises(RequestFailed, match=r"the ROS 2 server of /set did not answer within 0\.5 s"):
            console.request("add", question, timeout=5.0)
        assert not part._end._client._pending_requests
        for bad in (b"", b"\0\1\0\0", b"\xff" * 50):
            with pytest.raises(RequestFailed, match="not a message of std_srvs/srv/SetBool|no serialized message"):
                console.request("add", bad, timeout=5.0)
        assert (counts(out)["no_reply"], counts(out)["malformed"], counts(out)["replies"]) == (2, 3, 0)
        assert len(node.asked("/set")) == 1


def test_a_client_without_a_server_waits_in_vain_and_holds_up_nobody(company, ros_domains, ros_nodes, caplog):
    there = next(ros_domains)
    robot, server, _ = company(SERVED + service("other", ["robot"], ["server"]), "robot", "server", "console")
    both = (route(there, out=False, timeout=2.0), route(there, out=False, name="/other", alias="other"))
    with Ros2Proxy(server, Routes((), both[0].services + both[1].services)) as into:
        robot.serve("other", lambda _: serialize_message(SetBool.Response(message="quick")))
        node = ros_nodes(there, "node")
        with ThreadPoolExecutor() as pool:
            vain = pool.submit(node.call, "/set", SetBool, SetBool.Request(), 3.0)
            assert until(lambda: counts(into)["requests"] == 1)
            assert node.call("/other", SetBool, SetBool.Request(), 1.5).message == "quick"
            assert vain.result() is None
        assert until(lambda: counts(into)["no_reply"] == 1)
        assert "no reply for a client on /set" in caplog.text


@pytest.mark.parametrize("reply", [b"", b"\0\1\0\0", b"\xff" * 50, b"\0\1\0\0\1\0\0\0\xff\xff\xff\x7f"])
def test_a_reply_that_is_none_never_reaches_the_client(company, ros_domains, ros_nodes, reply):
    there = next(ros_domains)
    robot, server, _ = company(SERVED, "robot", "server", "console")
    robot.serve("add", lambda _: reply)
    with Ros2Proxy(server, route(there, out=False)) as into:
        assert ros_nodes(there, "node").call("/set", SetBool, SetBool.Request(), 1.0) is None
        assert counts(into)["no_reply"] == 1


def test_damaged_messages_are_refused_and_never_end_the_process():
    """What comes from the fleet is parsed by the C code of ROS 2."""
    rng = random.Random(0)
    for good in (Arrays.Request(string_values=["a", "bc", "d"]), parameters("a")):
        kind, whole = type(good), serialize_message(good)
        for _ in range(2000):
            data = bytearray(whole[: rng.randrange(5, len(whole) + 1)])
            for _ in range(rng.randrange(4)):
                data[rng.randrange(4, len(data))] = rng.choice((0, 1, 127, 255, rng.randrange(256)))
            try:
                deserialize_message(bytes(data), kind)
            except Exception as error:
                assert "deserialize" in str(error)


def parameters(text):
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=text)
    return SetParameters.Request(parameters=[Parameter(name="greeting", value=value)])


def test_parameters_of_a_node_can_be_set_and_read_from_another_domain(company, ros_domains, ros_nodes):
    here, there = next(ros_domains), next(ros_domains)
    policy = service("get", ["robot"], ["server"]) + service("set", ["robot"], ["server"])
    robot, server = company(policy, "robot", "server")
    node, operator = ros_nodes(here, "arm"), ros_nodes(there, "operator")
    node.parameter("greeting", "hello")

    def routes(domain, out):
        each = {"domain": domain, "out": out}
        get = route(alias="get", name="/arm/get_parameters", type_name="rcl_interfaces/srv/GetParameters", **each)
        set_ = route(alias="set", name="/arm/set_parameters", type_name="rcl_interfaces/srv/SetParameters", **each)
        return Routes((), get.services + set_.services)

    with Ros2Proxy(robot, routes(here, True)), Ros2Proxy(server, routes(there, False)):
        names = GetParameters.Request(names=["greeting"])
        assert operator.call("/arm/get_parameters", GetParameters, names).values[0].string_value == "hello"
        assert operator.call("/arm/set_parameters", SetParameters, parameters("Grüß Gott")).results[0].successful
        assert node.parameter("greeting") == "Grüß Gott"


def test_one_end_may_be_cyclone_dds_and_the_other_rclpy(company, ros_domains, ros_nodes):
    """What travels is the message, whatever the middleware of an end does with it."""
    here, there = next(ros_domains), next(ros_domains)
    robot, server, _ = company(SERVED, "robot", "server", "console")
    with Ros2Proxy(robot, route(here, out=True, through="dds")), Ros2Proxy(server, route(there, out=False)):
        cyclone, node = RawService(here, "/set", SET, serves=True), ros_nodes(there, "node")
        with ThreadPoolExecutor() as pool:
            call = pool.submit(node.call, "/set", SetBool, SetBool.Request(data=True))
            identity_and_request = cyclone.take()
            assert identity_and_request[20:21] == b"\1"
            answer = serialize_message(SetBool.Response(success=True, message="from Cyclone DDS"))
            dds_raw.write(cyclone.writer, identity_and_request[:20], answer[4:])
            assert call.result() == SetBool.Response(success=True, message="from Cyclone DDS")


def test_without_rclpy_in_between_a_service_of_fast_dds_is_refused_and_nobody_gets_nonsense(
    company, ros_domains, ros_nodes, caplog
):
    """Cyclone DDS and Fast DDS find each other's services, but do not understand them."""
    here, there = next(ros_domains), next(ros_domains)
    robot, server, console = company(SERVED, "robot", "server", "console")
    a, b = ros_nodes(here, "a"), ros_nodes(there, "b")
    a.serve("/echo", BasicTypes)
    dds = {"type_name": ECHO, "name": "/echo", "through": "dds"}
    request = BasicTypes.Request(string_value="long enough to be read as something else")
    with Ros2Proxy(robot, route(here, out=True, **dds)) as out, Ros2Proxy(server, route(there, out=False, **dds)) as into:
        with pytest.raises(RequestFailed, match='say through = "rclpy" for the service'):
            console.request("add", serialize_message(request), timeout=10.0)
        assert b.call("/echo", BasicTypes, request, 0.5) is None
        (part,) = into._parts
        assert until(lambda: part._end._reader.matched)
        assert b.call("/echo", BasicTypes, request, 0.5, insist=True) is None
        assert until(lambda: counts(into)["malformed"] > 0)
        assert counts(into)["requests"] == 0
        assert counts(out)["no_reply"] == 1
        assert a.asked("/echo") == []
        assert 'say through = "rclpy" for the service' in caplog.text


def test_two_proxies_of_one_domain_do_not_ask_each_other(company, ros_domains, ros_nodes):
    """One brings the service to the domain, the other would take it from there: each request would go round for ever."""
    here = next(ros_domains)
    robot, server, console = company(SERVED, "robot", "server", "console")
    with Ros2Proxy(server, route(here, out=False, timeout=3.0)) as into, Ros2Proxy(robot, route(here, out=True)) as out:
        (part,) = out._parts
        assert until(lambda: part._end._domain.other_proxy_serves("/set"))
        with pytest.raises(RequestFailed, match=f"another proxy brings /set to domain {here}"):
            console.request("add", serialize_message(SetBool.Request()), timeout=5.0)
        assert counts(into)["requests"] == 0


def action(node, domain, direction):
    entry = {
        "alias": "fold",
        "name": "/fold",
        "type": "test_msgs/action/Fibonacci",
        "direction": direction,
        "domain": domain,
        "through": "rclpy",
    }
    return parse_routes({"version": 1, "action": [entry]}, node.access)


def test_an_action_gives_feedback_and_a_result_and_can_be_cancelled(company, ros_domains, ros_nodes):
    here, there = next(ros_domains), next(ros_domains)
    parts = ("send_goal", "cancel_goal", "get_result")
    policy = "".join(service(f"fold-{part}", ["robot"], ["server"], interface=f"/{part}") for part in parts)
    policy += "".join(topic(f"fold-{part}", ["robot"], ["server"], interface=f"/{part}") for part in ("feedback", "status"))
    robot, server = company(policy, "robot", "server")
    arm, operator = ros_nodes(here, "arm"), ros_nodes(there, "operator")
    arm.serve_fibonacci("/fold", 0.1)
    operator.use_fibonacci("/fold")
    with Ros2Proxy(robot, action(robot, here, "out")) as out, Ros2Proxy(server, action(server, there, "in")) as into:
        assert joined(out, into)
        status, result, feedback = operator.fibonacci(8)
        assert status == GoalStatus.STATUS_SUCCEEDED
        assert result == [0, 1, 1, 2, 3, 5, 8, 13, 21]
        assert feedback == [3, 4, 5, 6, 7, 8, 9]
        status, result, feedback = operator.fibonacci(100, cancel_after=3)
        assert status == GoalStatus.STATUS_CANCELED
        assert len(result) < 50


def test_a_type_that_is_not_installed_is_one_line(company, ros_domains):
    here = next(ros_domains)
    robot, _, _ = company(SERVED, "robot", "server", "console")
    with pytest.raises(ConfigError, match=f"the type {ADD} is not installed where this proxy runs"):
        Ros2Proxy(robot, route(here, out=True, type_name=ADD))
