"""A whole fleet in one folder of one machine, to try things out: an authority, homes with certificates, routers on loopback.

    with LocalFleet(Path("fleet"), policy, ["arm", "server"]) as fleet, fleet.open("arm") as arm:
        ...

Everything is as in the field (keys, access control, sealing); only that one program holds all of it.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Self

from tutelage.sgc.authority import Authority
from tutelage.sgc.home import Home
from tutelage.sgc.node import Node
from tutelage.sgc.ports import free_ports
from tutelage.sgc.router import Router, RouterConfig
from tutelage.sgc.rules import Role
from tutelage.sgc.transport.config import Endpoint, NetworkConfig


class LocalFleet:
    """Made on construction; routers run from `__enter__` to `__exit__`.

    Attributes:
        authority: signs; `authority.revoke(name)` gives the notice for the homes.
        homes: of nodes and routers, by name. Routers are called router-1, router-2, ...
        routers: those that run; closing one is as if its machine went down.
        addresses: of the routers, in the order in which nodes try them (`network.toml`).
    """

    def __init__(
        self,
        folder: Path,
        policy: str,
        nodes: Iterable[str],
        *,
        routers: int = 1,
        protocol: str = "tls",
        name: str = "local",
        host: str = "127.0.0.1",
    ) -> None:
        """
        Args:
            folder: empty, or not there yet.
            policy: text of the policy file.
            protocol: tls, quic, ws or wss.
            name: of the fleet.
            host: address of this machine at which the routers listen.

        Raises:
            ConfigError: the policy has a fault.
            KeysError: the folder holds a fleet already.
        """
        self.authority = Authority.create(folder / "authority", name)
        self.homes: dict[str, Home] = {}
        for node in nodes:
            self.homes[node] = Home.create(folder / node, node)
        for k in range(routers):
            router = f"router-{k + 1}"
            self.homes[router] = Home.create(folder / router, router, role=Role.ROUTER, addresses=(host,))
        for home in self.homes.values():
            home.accept(self.authority.issue(home.request()))
        self.publish(policy)
        self.routers: list[Router] = []
        self.addresses = [f"{protocol}/{host}:{port}" for port in free_ports(routers)]
        network = NetworkConfig(tuple(map(Endpoint.parse, self.addresses)))
        for node in nodes:
            network.save(self.homes[node].path)

    def publish(self, policy: str) -> None:
        """A new policy, carried to everybody.

        Raises:
            ConfigError: the policy has a fault; the old one stays.
        """
        (self.authority.path / "policy.toml").write_text(policy, encoding="utf-8")
        for name, bundle in self.authority.publish().items():
            self.homes[name].accept(bundle)

    def open(self, name: str) -> Node:
        """A node, on the network."""
        return Node.open(self.homes[name].path)

    def __enter__(self) -> Self:
        for k, address in enumerate(self.addresses):
            router = Router(self.homes[f"router-{k + 1}"], RouterConfig.of([address], self.addresses[:k]))
            router.start()
            self.routers.append(router)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for router in self.routers:
            router.close()
        self.routers.clear()
