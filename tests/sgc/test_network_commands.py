"""The verbs router, ping and top, as a person uses them."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from sgc.fleets import Fleet, Programs, eventually, free_port, topic

from tutelage.cli import main
from tutelage.errors import ConfigError
from tutelage.sgc.commands.stopping import Stop, until_stopped
from tutelage.sgc.router import Router, RouterConfig
from tutelage.sgc.rules import Role
from tutelage.sgc.transport.config import Endpoint, NetworkConfig

pytest.importorskip("zenoh", reason="needs the extra sgc")

TUTELAGE = [sys.executable, "-c", "from tutelage.cli import main; main()"]


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return Fleet(tmp_path, topic("log", ["arm"], ["server"]), ["arm", "server"], ["router"])


def fails(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_a_router_a_node_and_somebody_who_looks(fleet: Fleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = f"tls/127.0.0.1:{free_port()}"
    for name in ("arm", "server"):
        NetworkConfig((Endpoint.parse(where),)).save(fleet[name].path)
    health = f"127.0.0.1:{free_port()}"
    command = [*TUTELAGE, "router", str(fleet["router"].path), "--listen", where, "--health", health]
    router = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert router.stdout
        assert router.stdout.readline() == f"router listens on {where}; Ctrl-C ends it\n"
        with Programs(tmp_path) as programs:
            programs.start("publish", fleet["arm"].path, "log", 0.02)
            server = str(fleet["server"].path)
            main(["ping", server, "--count", "2", "--interval", "0"])
            said = capsys.readouterr().out
            assert said.count("arm ") == 3
            assert "2 of 2 answered" in said
            main(["top", server, "--interval", "0.5", "--count", "3"])
            said = capsys.readouterr().out.split("server: connected")[-1]
            node, row = (
                next(line.split() for line in said.splitlines() if line.startswith(start)) for start in ("arm", "log")
            )
            assert node[2:] == ["ms", "log"]
            assert row[:2] == ["log", "arm"]
            assert 20 < float(row[2]) < 80
            from sgc.test_health import get

            assert get(f"http://{health}/healthz")[0] == 200
            assert "tutelage_sgc_connected_nodes 1" in get(f"http://{health}/metrics")[1]
        assert "nobody else is present on the topics of server" in fails(["ping", server, "--timeout", "0.3"], capsys)
        assert "no answer from arm" in fails(["ping", server, "arm", "--count", "1", "--timeout", "0.3"], capsys)
    finally:
        router.send_signal(signal.SIGTERM)
        assert router.wait(10) == 0


def test_faults_are_one_line_that_names_the_remedy(fleet: Fleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arm, router = str(fleet["arm"].path), str(fleet["router"].path)
    assert "arm is a node; a router needs a home of its own" in fails(["router", arm], capsys)
    assert "'tls/x' is no address" in fails(["router", router, "--listen", "tls/x"], capsys)
    assert "a router must listen somewhere" in fails(["router", router, "--listen"], capsys)
    assert "cannot listen on tls/192.0.2.1:1" in fails(["router", router, "--listen", "tls/192.0.2.1:1"], capsys)
    assert "is no node's home" in fails(["ping", str(tmp_path / "nothing")], capsys)
    assert "so where are the routers?" in fails(["ping", arm], capsys)
    assert "ping needs a count" in fails(["ping", arm, "--count", "0"], capsys)
    assert "top needs an interval" in fails(["top", arm, "--interval", "0"], capsys)
    assert "ping needs a count" in fails(["ping", arm, "--timeout", "nan"], capsys)
    assert "top needs an interval" in fails(["top", arm, "--interval", "nan"], capsys)
    health = ["router", router, "--listen", f"tls/127.0.0.1:{free_port()}", "--health"]
    assert "'127.0.0.1:²' is no address to serve health on" in fails([*health, "127.0.0.1:²"], capsys)
    assert "'127.0.0.1:²' is no address" in fails(["proxy", "rosbridge", arm, "--listen", "127.0.0.1:²"], capsys)
    assert "0 to 86400 seconds, not -1" in fails(["proxy", "topics", "--seconds", "-1"], capsys)
    NetworkConfig((Endpoint("tls", "127.0.0.1", free_port()),)).save(fleet["arm"].path)
    assert "arm reaches none of its routers" in fails(["ping", arm, "--timeout", "0.2"], capsys)
    assert "arm is not in subscribe of topic 'log'" in fails(["top", arm, "--topics", "log"], capsys)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_whoever_serves_renewals_ends_in_order(tmp_path: Path, number: signal.Signals) -> None:
    fleet = Fleet(tmp_path, 'version = 1\nrenewals = "server"\n' + topic("log", ["arm"], ["server"]), ["arm", "server"])
    NetworkConfig((Endpoint("tls", "127.0.0.1", free_port()),)).save(fleet["server"].path)
    command = [*TUTELAGE, "keys", "serve", str(fleet.authority.path), str(fleet["server"].path)]
    office = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert office.stdout
    assert office.stdout.readline() == "server renews certificates of acme; Ctrl-C ends it\n"
    office.send_signal(number)
    assert office.wait(10) == 0


def test_a_router_that_cannot_listen_everywhere_lets_go_of_what_it_has(fleet: Fleet) -> None:
    where = f"tls/127.0.0.1:{free_port()}"
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        router = Router(fleet["router"], RouterConfig.of([where, f"wss/127.0.0.1:{taken.getsockname()[1]}"]))
        with pytest.raises(ConfigError, match="cannot listen on wss"):
            router.start()
        assert not router.running
    with Router(fleet["router"], RouterConfig.of([where])) as again:
        assert again.running


def test_a_router_whose_port_was_taken_when_it_started_again_comes_back(fleet: Fleet, monkeypatch) -> None:
    def taken() -> None:
        raise ConfigError("cannot listen")

    with Router(fleet["router"], RouterConfig.of([f"tls/127.0.0.1:{free_port()}"])) as router:
        monkeypatch.setattr(router, "_insist", lambda begin: begin())
        begin = router._begin
        monkeypatch.setattr(router, "_begin", taken)
        fleet.join("late", Role.NODE)
        fleet["router"].accept((fleet.authority.path / "outbox" / "router.bundle").read_bytes())
        eventually(lambda: not router.running)
        monkeypatch.setattr(router, "_begin", begin)
        eventually(lambda: router.running)


def test_a_signal_that_another_thread_takes_stops_a_program_as_well() -> None:
    with until_stopped() as stop:
        threading.Timer(0.1, lambda: signal.pthread_kill(threading.get_ident(), signal.SIGTERM)).start()
        assert stop.wait(10.0)
    assert not Stop().wait(0.01)
