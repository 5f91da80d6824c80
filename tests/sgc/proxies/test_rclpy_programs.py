"""ROS 2 nodes, proxies and a router, each a program of its own as people start them: `make ros2`."""

from __future__ import annotations

import signal

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed (make ros2 installs it beside)")

from sgc.commands.test_proxy import start
from sgc.fleets import behind_a_router, service, topic
from sgc.proxies.ros_ends import until
from std_msgs.msg import String
from std_srvs.srv import SetBool

POLICY = topic("chat", ["robot", "server"], ["robot", "server"]) + service(
    "lights", ["robot"], ["server"], type="std_srvs/srv/SetBool"
)
ROUTES = """
version = 1
distribution = "jazzy"

[[topic]]
alias = "chat"
domain = {domain}
queue = 400
qos = {{profile = "default", depth = 400}}

[[service]]
alias = "lights"
direction = "{direction}"
through = "rclpy"
domain = {domain}
"""


@pytest.fixture
def fleet(tmp_path):
    with behind_a_router(tmp_path, POLICY, ["robot", "server"]) as fleet:
        yield fleet


def test_two_sites_joined_by_the_command_line(fleet, ros_domains, ros_nodes, tmp_path):
    domains = {"robot": next(ros_domains), "server": next(ros_domains)}
    nodes = {name: ros_nodes(domain, name) for name, domain in domains.items()}
    for node in nodes.values():
        node.subscribe("/chat", String)
        node.advertise("/chat", String)
    nodes["robot"].serve("/lights", SetBool, success=True, message="on")
    running = []
    for name, direction in (("robot", "out"), ("server", "in")):
        routes = tmp_path / f"{name}.toml"
        routes.write_text(ROUTES.format(domain=domains[name], direction=direction))
        process, said = start("ros2", fleet[name].path, routes)
        running.append(process)
        assert said.startswith(f"{name}: 1 topic and 1 service between DDS domain {domains[name]} and the fleet")
    try:
        for here, there in (("robot", "server"), ("server", "robot")):
            ready, said = String(data=f"is {there} there?"), [String(data=f"{here} {i}") for i in range(300)]

            def is_heard(here=here, there=there, ready=ready):
                nodes[here].publish("/chat", [ready])
                return ready in nodes[there].heard("/chat")

            assert until(is_heard, 30.0)
            nodes[here].publish("/chat", said)
            assert until(lambda there=there, said=said: said[-1] in nodes[there].heard("/chat"), 20.0)
            assert [message for message in nodes[there].heard("/chat") if message in said] == said
        reply = nodes["server"].call("/lights", SetBool, SetBool.Request(data=True), 20.0)
        assert reply == SetBool.Response(success=True, message="on")
    finally:
        for process in running:
            process.send_signal(signal.SIGTERM)
        assert [process.wait(20) for process in running] == [0, 0]
