"""Counters, their Prometheus text, and the two pages."""

from __future__ import annotations

import http.client
import json
import socket
import struct
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from sgc.fleets import Fleet, eventually, topic

from tutelage.errors import ConfigError
from tutelage.sgc.health import node_health, prometheus
from tutelage.sgc.health_server import HealthServer
from tutelage.sgc.node import Node
from tutelage.sgc.transport.memory import MemoryTransport, Network


def get(url: str) -> tuple[int, str]:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(url, timeout=5) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_a_tree_of_counters_becomes_prometheus_text() -> None:
    tree = {
        "connected": 1,
        "refused": {"forged": 2},
        "topics": {'cam"1"': {"subscriber": {"received": 3, "refused": {"too_old": 4}, "latency": {"arm": 0.25}}}},
    }
    assert prometheus(tree, "x").splitlines() == [
        "x_connected 1",
        'x_refused{reason="forged"} 2',
        'x_subscriber_latency{topic="cam\\"1\\"",sender="arm"} 0.25',
        'x_subscriber_received{topic="cam\\"1\\""} 3',
        'x_subscriber_refused{topic="cam\\"1\\"",reason="too_old"} 4',
    ]


def test_health_and_metrics_of_a_node(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, topic("log", ["arm"], ["server"]), ["arm", "server"])
    network = Network()
    server = Node.open(fleet["server"], MemoryTransport(network))
    with server, HealthServer("127.0.0.1:0", lambda: node_health(server), server.counters) as pages:
        url = f"http://127.0.0.1:{pages.port}"
        code, text = get(f"{url}/healthz")
        assert (code, json.loads(text)["problems"]) == (503, ["no key yet of: log"])
        with Node.open(fleet["arm"], MemoryTransport(network)) as arm:
            server.subscribe("log")
            eventually(lambda: get(f"{url}/healthz")[0] == 200)
            arm.publisher("log").send(b"hello")
            eventually(lambda: 'tutelage_sgc_subscriber_received{topic="log"} 1' in get(f"{url}/metrics")[1])
            network.up = False
            code, text = get(f"{url}/healthz")
            assert (code, json.loads(text)["problems"]) == (503, ["not connected to a router"])
        assert get(f"{url}/else")[0] == 404


def test_whoever_hangs_up_leaves_no_traceback_and_a_fault_of_ours_is_logged(capfd, caplog) -> None:
    def broken() -> dict[str, object]:
        raise KeyError("oh")

    with HealthServer("127.0.0.1:0", broken, lambda: {"x": {str(k): k for k in range(200_000)}}) as pages:
        for asked in (b"GET /metrics HTTP/1.0\r\n\r\n", b"GET"):
            client = socket.create_connection(("127.0.0.1", pages.port))
            client.sendall(asked)
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset, not a farewell
            client.close()
        with pytest.raises((OSError, http.client.HTTPException)):
            get(f"http://127.0.0.1:{pages.port}/healthz")
        eventually(lambda: "health, as asked by" in caplog.text)
    assert capfd.readouterr().err == ""


def test_counts_of_two_subscriptions_of_a_topic_add_up(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, topic("log", ["arm"], ["server"]), ["arm", "server"])
    network = Network()
    with (
        Node.open(fleet["server"], MemoryTransport(network)) as server,
        Node.open(fleet["arm"], MemoryTransport(network)) as arm,
    ):
        first, second = server.subscribe("log"), server.subscribe("log")
        arm.publisher("log").send(b"hello")
        assert first.receive(5.0) is not None
        assert second.receive(5.0) is not None
        counts = server.counters()["topics"]["log"]["subscriber"]
        assert (counts["received"], counts["bytes"]) == (2, 10)


@pytest.mark.parametrize("address", ["", "9090", ":9090", "127.0.0.1:x", "127.0.0.1:99999"])
def test_an_impossible_address_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match="is no address to serve health on; write HOST:PORT"):
        HealthServer(address, dict, dict)


def test_an_address_in_use_is_refused() -> None:
    with HealthServer("127.0.0.1:0", dict, dict) as pages, pytest.raises(ConfigError, match="cannot serve health on"):
        HealthServer(f"127.0.0.1:{pages.port}", dict, dict)
