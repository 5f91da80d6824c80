"""`tutelage keys`: a fleet is made, grows, changes and loses members by commands alone; mistakes are one line."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from members import POLICY

from tutelage.cli import main
from tutelage.sgc.home import Home
from tutelage.sgc.keyring import Keyring
from tutelage.sgc.sealing import Opener, Sealer
from tutelage.sgc.transport.config import NetworkConfig

Keys = Callable[[str], str]


@pytest.fixture
def keys(tmp_path, monkeypatch, capsys) -> Keys:
    """Run `tutelage keys ...` in a folder of the test's own; gives what it says."""
    monkeypatch.chdir(tmp_path)

    def run(line: str) -> str:
        main(["keys", *shlex.split(line)])
        return capsys.readouterr().out

    return run


@pytest.fixture
def fails(keys: Keys, capsys) -> Keys:
    """Run a command that must fail; gives its one line."""

    def run(line: str) -> str:
        with pytest.raises(SystemExit) as raised:
            keys(line)
        assert raised.value.code == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        return said

    return run


def test_from_nothing_to_the_first_message(keys: Keys) -> None:
    keys("init fleet --fleet acme")
    Path("fleet/policy.toml").write_text(POLICY)
    keys("init drone --node drone-1 --connect tls/192.0.2.7:7447")
    keys("init server --node server")
    keys("issue fleet drone server/request.pem --policy")
    keys("renew server --bundle fleet/outbox/server.bundle")
    drone, server = (Keyring(Home.open(Path(name))) for name in ("drone", "server"))
    server.accept("camera", drone.answer("camera", server.ask("camera")))
    assert Opener(server, "camera").open(Sealer(drone, "camera").seal(b"hello")).payload == b"hello"
    assert [str(router) for router in NetworkConfig.load(Path("drone")).routers] == ["tls/192.0.2.7:7447"]


def test_a_router_named_before_the_nodes_lets_them_through(keys: Keys) -> None:
    keys("init fleet --fleet acme")
    keys("init hub --router hub --address 127.0.0.1")
    for name in ("drone-1", "server", "late"):
        keys(f"init {name} --node {name}")
    assert "must hear" not in keys("issue fleet hub drone-1 server --policy")
    assert Home.open(Path("hub")).access.members == {Home.open(Path(name)).pseudonym for name in ("drone-1", "server")}
    assert "hub: the router must hear of them: tutelage keys renew HOME --bundle fleet/outbox/hub.bundle" in keys(
        "issue fleet late"
    )
    keys("renew hub --bundle fleet/outbox/hub.bundle")
    assert Home.open(Path("late")).pseudonym in Home.open(Path("hub")).access.members


def test_people_compare_fingerprints(keys: Keys) -> None:
    made = keys("init drone --node drone-1").splitlines()[-1].split()[-1]
    assert made in keys("show drone/request.pem")
    assert made in keys("show drone")
    assert "signing request of drone-1" in keys("show drone/request.pem")


def test_a_certificate_is_renewed_by_file_and_by_an_authority_on_this_machine(keys: Keys) -> None:
    keys("init fleet --fleet acme")
    keys("init drone --node drone-1")
    keys("issue fleet drone --hours 2")
    running = Home.open(Path("drone"))
    before = running.expires
    assert "drone-1 has a certificate until" in keys("renew drone --authority fleet --hours 48")
    assert running.refresh()
    assert running.expires > before + 40 * 3600


def test_a_revoked_node_is_named_and_the_list_is_carried(keys: Keys, fails: Keys) -> None:
    keys("init fleet --fleet acme")
    for name in ("drone-1", "server"):
        keys(f"init {name} --node {name}")
    keys("issue fleet drone-1 server")
    assert "deny list 1 of acme: drone-1 revoked" in keys("revoke fleet drone-1")
    assert "server knows deny list 1: 1 revoked" in keys("renew server --bundle fleet/outbox/deny")
    assert "drone-1 with these keys is no member of acme" in fails("renew drone-1 --authority fleet")
    assert "revoked drone-1: " in keys("show fleet")


def test_the_authority_is_renewed_by_the_offline_root(keys: Keys, fails: Keys) -> None:
    Path("secret").write_text("correct horse\n")
    keys("init fleet --fleet acme --passphrase-file secret")
    os.rename("fleet/root", "vault")
    assert "no root key fleet/root/root.key; bring the medium" in fails("renew fleet")
    assert "cannot read the root key" in fails("renew fleet --root-key vault/root.key")
    renewed = keys("renew fleet --root-key vault/root.key --passphrase-file secret")
    assert "the authority of acme has a new key, valid until" in renewed
    stolen = keys("renew fleet --root-key vault/root.key --passphrase-file secret --revoke-old")
    assert "what the old key signed is refused; carry the bundles in fleet/outbox to all nodes" in stolen
    assert "revoked authority " in keys("show fleet")


def test_what_is_shown_holds_no_secret(keys: Keys) -> None:
    keys("init fleet --fleet acme")
    Path("fleet/policy.toml").write_text(POLICY)
    keys("init drone --node drone-1")
    keys("init router-1 --router router-1 --address 192.0.2.7 r.example.org")
    keys("issue fleet drone router-1 --policy")
    home = Home.open(Path("drone"))
    key = Keyring(home).sealing("camera").key
    shown = keys("show drone") + keys("show fleet") + keys("show router-1")
    secrets = [key, home.access.secret, Path("fleet/names.secret").read_bytes(),
               *(entry.secret for entry in home.access.topics.values())]  # fmt: skip
    assert not [secret for secret in secrets if secret.hex() in shown]
    assert "stream camera: /camera of drone-1, signature, reliable; sends, owns; key " in shown
    assert "service grasp: /grasp of server, signature, reliable; sends, receives; no key yet; name " in shown
    assert "router router-1, addresses 192.0.2.7, r.example.org" in shown


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("init x", "name one of --fleet, --node and --router"),
        ("init x --node a --router b", "name one of --fleet, --node and --router"),
        ("init x --node 'a b'", "a node's name is 1 to 63 letters"),
        ("init x --router r", "a router needs at least one address"),
        ("init x --router r --address ?", "'?' is neither an IP address nor a host name"),
        ("init x --node a --address 192.0.2.7", "addresses are for routers"),
        ("init x --node a --connect nowhere", "'nowhere' is no address of a router"),
        ("init x --node a --root missing.pem", "no root certificate missing.pem"),
        ("init x --fleet acme --passphrase-file missing", "cannot read missing: No such file"),
        ("issue x", "x is no fleet's authority"),
        (
            "renew x",
            "x is no node's home (no node.json); make one: tutelage keys init x --node NAME (a router's: --router NAME)",
        ),
        ("revoke x a", "x is no fleet's authority"),
        ("show x", "x is no node's home"),
        ("serve x y", "x is no fleet's authority"),
    ],
)
def test_a_mistake_is_one_line(fails: Keys, line: str, says: str) -> None:
    assert says in fails(line)
    assert not Path("x").exists()


def test_mistakes_with_a_fleet_at_hand_are_one_line(keys: Keys, fails: Keys) -> None:
    keys("init fleet --fleet acme")
    keys("init drone --node drone-1")
    Path("junk").write_text("junk")
    assert "name signing requests" in fails("issue fleet")
    assert "not a signing request" in fails("issue fleet junk")
    assert "not a signing request" in fails("show junk")
    assert "carry drone/request.pem to the authority" in fails("renew drone")
    keys("issue fleet drone")
    assert "junk is neither a bundle nor a deny list, or is damaged" in fails("renew drone --bundle junk")
    assert "the policy of acme names no node for renewals" in fails("renew drone")
    assert 'does not let drone-1 renew certificates; write renewals = "drone-1" at its top' in fails("serve fleet drone")
    assert "name at least one node" in fails("revoke fleet")
    assert "acme has no member 'x'; members: drone-1" in fails("revoke fleet x")
    Path("fleet/policy.toml").write_text("version = 1\nrenewals = 'nobody'\n")
    keys("issue fleet --policy drone")
    assert "the policy of acme names no node for renewals" in fails("renew drone")


def test_mixed_up_folders_files_and_options_change_nothing_and_are_named(keys: Keys, fails: Keys) -> None:
    keys("init fleet --fleet acme")
    keys("init drone --node drone-1")
    keys("init server --node server")
    assert "fleet holds the authority of a fleet already" in fails("init fleet --node drone-2")
    assert "drone is the home of a node already" in fails("init drone --fleet other")
    assert "cannot make the folder fleet/policy.toml: File exists; choose another" in fails(
        "init fleet/policy.toml --node a"
    )
    assert "cannot read nofile" in fails("issue fleet drone nofile")
    assert "fleet/policy.toml: not a signing request" in fails("issue fleet drone fleet/policy.toml")
    assert "drone-1" not in keys("show fleet")  # one that cannot be read stops the others, too
    keys("issue fleet drone server")
    authority = Path("fleet/ca.key").read_bytes()
    assert "fleet is the folder of an authority; --bundle and --authority" in fails("renew fleet --bundle fleet/outbox/deny")
    assert "fleet is the folder of an authority; --bundle and --authority" in fails("renew fleet --authority fleet")
    assert Path("fleet/ca.key").read_bytes() == authority
    assert "drone is the folder of drone-1; --root-key, " in fails("renew drone --authority fleet --revoke-old")
    assert "drone-1 does not take fleet/outbox/server.bundle: sealed to another node, or damaged; it needs" in fails(
        "renew drone --bundle fleet/outbox/server.bundle"
    )
    assert "acme has no member 'nobody'" in fails("revoke fleet drone-1 nobody")
    assert "revoked" not in keys("show fleet")


def test_a_certificate_that_expired_is_not_renewed_over_the_network_and_the_way_out_is_named(
    keys: Keys, fails: Keys
) -> None:
    keys("init fleet --fleet acme")
    keys("init drone --node drone-1")
    keys("issue fleet drone --hours 0.001")
    time.sleep(3.7)
    assert "nobody on the network believes it: use --bundle, with what tutelage keys issue gives, or --authority" in fails(
        "renew drone"
    )
    keys("renew drone --authority fleet")
    assert "names no node for renewals" in fails("renew drone")


def test_a_node_that_believes_another_root_is_named(keys: Keys, fails: Keys) -> None:
    keys("init fleet --fleet acme")
    keys("init other --fleet other")
    keys("init drone --node drone-1 --root other/root.pem")
    assert "drone does not take fleet/outbox/drone-1.bundle, the certificate of drone-1: a cert" in fails(
        "issue fleet drone"
    )
    Path("fleet/root.pem").write_bytes(Path("other/root.pem").read_bytes())
    assert "fleet is damaged: ca.pem does not come from root.pem; restore it" in fails("issue fleet drone")


def test_names_in_a_policy_that_are_no_nodes_are_said(keys: Keys, fails: Keys) -> None:
    keys("init fleet --fleet acme")
    keys("init drone --node drone-1")
    keys("init hub --router hub --address 127.0.0.1")
    Path("fleet/policy.toml").write_text(POLICY)
    said = keys("issue fleet drone hub --policy")
    assert "the policy names operator-1, server, no members of acme yet" in said or "the policy names server, no" in said
    Path("fleet/policy.toml").write_text(POLICY.replace('owner = "drone-1"', 'owner = "hub"', 1))
    assert "fleet/policy.toml: owner of " in (line := fails("issue fleet --policy"))
    assert "is hub, a router; only nodes have a part in it" in line
    Path("fleet/policy.toml").write_text("version = 1\nrenewals = 'hub'\n")
    assert "fleet/policy.toml: renewals is hub, a router" in fails("issue fleet --policy")
    Path("fleet/published.toml").unlink()
    assert "acme has no signed policy (no fleet/published.toml): tutelage keys issue fleet --policy" in fails(
        "issue fleet drone"
    )


def test_without_the_extra_the_verbs_name_it(tmp_path) -> None:
    code = "import sys; sys.modules['cryptography'] = None; from tutelage.cli import main; main(['keys', 'show', '.'])"
    said = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert said.returncode == 2
    assert said.stderr.strip() == "tutelage: cryptography is not installed; run: pip install 'tutelage[sgc]'"
