"""`tutelage keys serve` over real routers: nodes, routers and commands get certificates, policies and deny lists by themselves."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

zenoh = pytest.importorskip("zenoh", reason="needs the extra sgc")

from fleets import Fleet, eventually, free_port, topic  # noqa: E402

from tutelage.cli import main  # noqa: E402
from tutelage.sgc import lanes  # noqa: E402
from tutelage.sgc.node import Node  # noqa: E402
from tutelage.sgc.renewal import Renewer  # noqa: E402
from tutelage.sgc.router import Router, RouterConfig  # noqa: E402
from tutelage.sgc.transport.base import NoReply  # noqa: E402
from tutelage.sgc.transport.config import Endpoint, NetworkConfig  # noqa: E402

POLICY = 'version = 1\nrenewals = "office"\n' + topic("log", ["arm"], ["server"])


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return Fleet(tmp_path, POLICY, ["office", "arm", "server"], ["router-1"])


@pytest.fixture
def router(fleet: Fleet) -> Iterator[Router]:
    where = f"tls/127.0.0.1:{free_port()}"
    for name in ("office", "arm", "server"):
        NetworkConfig((Endpoint.parse(where),)).save(fleet.homes[name].path)
    with Router(fleet.homes["router-1"], RouterConfig.of([where])) as running:
        yield running


@pytest.fixture
def office(fleet: Fleet, router: Router) -> Iterator[subprocess.Popen[str]]:
    """The command, as people run it."""
    code = f"from tutelage.cli import main; main(['keys', 'serve', {str(fleet.authority.path)!r}, {str(fleet.homes['office'].path)!r}])"
    running = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert running.stdout is not None
    assert running.stdout.readline() == "office renews certificates of acme; Ctrl-C ends it\n"
    yield running
    os.kill(running.pid, signal.SIGINT)
    assert running.wait(30) == 0
    running.stdout.close()
    assert running.stderr is not None
    running.stderr.close()


def test_a_certificate_is_renewed_over_the_network_by_command(fleet: Fleet, office, capsys) -> None:
    arm = fleet.homes["arm"]
    before = arm.leaf_file.read_bytes()
    main(["keys", "renew", str(arm.path)])
    assert "arm has a certificate until" in capsys.readouterr().out
    assert arm.refresh()
    assert arm.leaf_file.read_bytes() != before


def test_running_nodes_and_routers_learn_what_is_new(fleet: Fleet, router: Router, office) -> None:
    with Node.open(fleet.homes["arm"].path) as arm:
        eventually(lambda: arm.connected)
        renewer = Renewer(arm.home, arm.transport.request)
        assert renewer.once() is False
        fleet.authority.revoke("server")
        renewer.once()  # if the node's own has not asked a moment before
        assert len(arm.home.trust.deny_list.pseudonyms) == 1
        (fleet.authority.path / "policy.toml").write_text(POLICY + topic("more", ["arm"], ["office"]))
        fleet.authority.publish()
        renewer.once()
        assert set(arm.access.topics) == {"log", "more"}
    newcomer = fleet.join("drone")
    Renewer(router.home, router._ask).once()
    assert newcomer.pseudonym in router.home.access.members


def test_nobody_but_the_office_is_asked(fleet: Fleet, router: Router) -> None:
    """A member that answers in the office's place is not let by the router, so the question finds nobody."""
    with Node.open(fleet.homes["server"].path) as impostor, Node.open(fleet.homes["arm"].path) as arm:
        asked: list[bytes] = []
        impostor.transport.serve(lanes.key(impostor.access.control, lanes.RENEW), lambda question: asked.append(question))
        eventually(lambda: arm.connected and impostor.connected)
        with pytest.raises(NoReply):
            Renewer(arm.home, lambda key, payload, _: arm.transport.request(key, payload, 1.0)).once()
        assert asked == []


def test_without_an_office_the_command_says_so(fleet: Fleet, router: Router, capsys, monkeypatch) -> None:
    monkeypatch.setattr("tutelage.sgc.renewal.ANSWER_SECONDS", 0.5)
    with pytest.raises(SystemExit) as raised:
        main(["keys", "renew", str(fleet.homes["arm"].path)])
    assert raised.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "arm" in said or "answer" in said
