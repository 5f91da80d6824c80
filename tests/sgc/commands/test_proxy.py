"""`tutelage proxy` as people start it: a process of its own that dials out to a router."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import urllib.request

import pytest
from sgc.fleets import behind_a_router, free_port, service, topic
from sgc.proxies.company import stay_on_loopback
from sgc.proxies.ros_ends import ADD, RosNode, taken, until
from websockets.sync.client import connect

from tutelage.errors import ConfigError
from tutelage.sgc.commands import proxy
from tutelage.sgc.errors import KeysError

POLICY = topic("chat", ["robot", "web"], ["robot", "web"], interface="/chatter") + service(
    "add", ["robot"], ["web"], type=ADD
)
ROUTES = """
version = 1

[[topic]]
alias = "chat"
domain = {domain}

[[service]]
alias = "add"
direction = "out"
domain = {domain}
"""


@pytest.fixture
def fleet(tmp_path):
    with behind_a_router(tmp_path, POLICY, ["robot", "web"]) as fleet:
        yield fleet


def start(*arguments):
    """The process, and the line by which it says that it runs."""
    code = "import sys; from tutelage.cli import main; main(sys.argv[1:])"
    command = [sys.executable, "-c", code, "proxy", *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    return process, process.stdout.readline().strip()


def test_a_page_talks_to_a_ros_domain_through_two_proxies_and_a_router(fleet, tmp_path):
    stay_on_loopback()
    domain, health = 79, free_port()
    routes = tmp_path / "routes.toml"
    routes.write_text(ROUTES.format(domain=domain))
    ros2, said = start("ros2", fleet["robot"].path, routes, "--health", f"127.0.0.1:{health}")
    web, said_web = start("rosbridge", fleet["web"].path, "--listen", "127.0.0.1:0")
    try:
        assert said == f"robot: 1 topic and 1 service between DDS domain {domain} and the fleet; Ctrl-C ends it"
        assert said_web.startswith("web: 1 topic and 1 service at ws://127.0.0.1:")
        node = RosNode(domain)
        listener = node.subscription("/chatter")
        assert until(listener.get_matched_publications)
        with connect(said_web.split()[7].rstrip(";"), compression=None) as page:
            page.send(json.dumps({"op": "subscribe", "topic": "/chatter"}))
            heard: list[str] = []

            def page_is_heard():
                page.send(json.dumps({"op": "publish", "topic": "/chatter", "msg": {"data": "from the page"}}))
                heard.extend(taken(listener, 1, 0.3))
                return heard

            assert until(page_is_heard, 20.0)
            assert heard[0] == "from the page"
            talker = node.say("/chatter", ["from the robot"])
            texts = iter(lambda: json.loads(page.recv(timeout=10.0))["msg"]["data"], "from the robot")
            assert set(texts) <= {"from the page"}
            del talker
        with urllib.request.urlopen(f"http://127.0.0.1:{health}/metrics") as answer:
            assert 'tutelage_sgc_proxy_out{topic="chat"} 1\n' in answer.read().decode()
        with urllib.request.urlopen(f"http://127.0.0.1:{health}/healthz") as answer:
            assert json.load(answer)["ok"] is True
    finally:
        for process in (ros2, web):
            process.send_signal(signal.SIGTERM)
        assert [process.wait(20) for process in (ros2, web)] == [0, 0]


def test_what_is_on_a_domain_is_listed(capsys):
    stay_on_loopback()
    node = RosNode(78)
    writer = node.publisher("/chatter")
    proxy.topics(domain=78, seconds=1.0)
    assert (
        capsys.readouterr().out
        == "topic  /chatter  std_msgs/msg/String  1 / 0 publishers, subscriptions  reliable  volatile\n"
    )
    del writer
    proxy.topics(domain=77, seconds=0.1)
    assert capsys.readouterr().out == "nothing of ROS 2 was seen on domain 77 within 0.1 s\n"


def test_the_interface_of_the_gateway_is_printed(capsys):
    proxy.proto()
    assert "service Gateway {" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("call", "error", "says"),
    [
        (lambda path: proxy.ros2(path, path / "routes.toml"), KeysError, "is no node's home"),
        (lambda path: proxy.rosbridge(path, listen="9090"), ConfigError, "'9090' is no address"),
        (lambda path: proxy.rosbridge(path, token_file=path / "token"), ConfigError, "cannot read the token"),
        (lambda path: proxy.grpc(path, certificate=path / "c"), ConfigError, "needs both --certificate and --key"),
        (lambda path: proxy.topics(domain=233), ConfigError, "DDS domains go from 0 to 232"),
    ],
)
def test_what_cannot_be_done_is_one_line(tmp_path, call, error, says):
    with pytest.raises(error, match=says):
        call(tmp_path)


def test_a_short_token_is_refused(tmp_path):
    (tmp_path / "token").write_text("short\n")
    with pytest.raises(ConfigError, match="has 5 characters; it needs 16 at least"):
        proxy.grpc(tmp_path, token_file=tmp_path / "token")
