"""A fleet in a temporary folder for the tests of connectivity: an authority, and nodes with homes and keys. Nothing is faked."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from tutelage.sgc.authority import Authority
from tutelage.sgc.home import Home
from tutelage.sgc.keyring import Keyring
from tutelage.sgc.rules import Lane, Role
from tutelage.sgc.sealing import Opener, Sealer

POLICY = """
version = 1

[topics.camera]
node = "drone-1"
interface = "/camera"
type = "sensor_msgs/msg/Image"
description = "front, 640x480"
owner = "drone-1"
publish = ["drone-*"]
subscribe = ["server", "operator-*"]

[topics.teleop]
node = "arm-3"
interface = "/teleop"
type = "geometry_msgs/msg/Twist"
owner = "operator-1"
publish = ["operator-*"]
subscribe = ["drone-1", "server"]
authenticity = "session"
max_age = 0.5

[topics.lidar]
node = "drone-1"
interface = "/lidar"
type = "sensor_msgs/msg/PointCloud2"
owner = "drone-1"
publish = ["drone-*"]
subscribe = ["server", "operator-*"]
authenticity = "chain"
delivery = "lossy"

[topics.grasp]
node = "server"
interface = "/grasp"
type = "grasp/srv/Plan"
kind = "service"
owner = "server"
serve = ["server"]
request = ["drone-*"]
"""
NODES = ("drone-1", "drone-2", "server", "operator-1")


class Fleet:
    """An authority and its nodes; by default with all keys handed out.

    `homes` and `keyrings` are by name of the node.
    """

    def __init__(self, path: Path, nodes: Iterable[str] = NODES, policy: str = POLICY, *, share: bool = True) -> None:
        self.path = path
        self.authority = Authority.create(path / "authority", "acme")
        (path / "authority" / "policy.toml").write_text(policy)
        self.authority.publish()
        self.homes: dict[str, Home] = {}
        self.keyrings: dict[str, Keyring] = {}
        for name in nodes:
            self.join(name)
        if share:
            self.share()

    def join(
        self, name: str, role: Role = Role.NODE, hours: float = 24.0, addresses: Iterable[str] = ("127.0.0.1",)
    ) -> Home:
        """A new member."""
        home = Home.create(self.path / name, name, role=role, addresses=tuple(addresses) if role == Role.ROUTER else ())
        home.accept(self.authority.issue(home.request(), hours=hours))
        self.homes[name] = home
        if role == Role.NODE:
            self.keyrings[name] = Keyring(home)
        return home

    def share(self) -> None:
        """Every node asks for the keys that it wants and whose owner is here."""
        for keyring in self.keyrings.values():
            for alias in keyring.wanted():
                owner = self.keyrings.get(keyring.home.access.entry(alias).rule.owner)
                if owner is not None:
                    keyring.accept(alias, owner.answer(alias, keyring.ask(alias)))

    def publish(self, policy: str) -> None:
        """Change the policy, and let everybody know."""
        (self.path / "authority" / "policy.toml").write_text(policy)
        for name, bundle in self.authority.publish().items():
            self.homes[name].accept(bundle)

    def revoke(self, name: str, *, tell: Iterable[str] | None = None) -> None:
        """Revoke a node; tell all others, or only some."""
        notice = self.authority.revoke(name)
        for other in self.homes if tell is None else tell:
            if other != name:
                self.homes[other].accept(notice)

    def sealer(self, name: str, alias: str, lane: Lane = Lane.STREAM) -> Sealer:
        """What a node sends with."""
        return Sealer(self.keyrings[name], alias, lane)

    def opener(self, name: str, alias: str, lane: Lane = Lane.STREAM, *, provisional: bool = False) -> Opener:
        """What a node receives with."""
        return Opener(self.keyrings[name], alias, lane, provisional=provisional)

    def pair(self, alias: str, sender: str, receiver: str) -> tuple[Sealer, Opener]:
        """Both ends of a stream, with a session if the topic needs one."""
        sealer, opener = self.sealer(sender, alias), self.opener(receiver, alias)
        if self.homes[sender].access.entry(alias).rule.authenticity == "session":
            opener.complete_session(sealer.accept_session(opener.offer_session()))
        return sealer, opener
