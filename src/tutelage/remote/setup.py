"""Keys, policy and homes of a whole fleet in one folder, to try things out; in the field every robot makes its own keys.

    FOLDER/authority, FOLDER/router-1, FOLDER/server, FOLDER/robot-1, ...

Everything is as in the field; only that one folder holds all of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tutelage.errors import ConfigError
from tutelage.remote.topics import fleet_policy
from tutelage.sgc.authority import Authority
from tutelage.sgc.home import Home
from tutelage.sgc.rules import Role
from tutelage.sgc.transport.config import Endpoint, NetworkConfig


@dataclass(frozen=True)
class FleetFolder:
    """What `new_fleet` made. Attributes are folders."""

    authority: Path
    router: Path
    server: Path
    robots: tuple[Path, ...]


def robot_names(robots: int) -> tuple[str, ...]:
    """robot-1, robot-2, ..."""
    return tuple(f"robot-{k + 1}" for k in range(robots))


def new_fleet(
    folder: Path,
    robots: int | Sequence[str] = 4,
    *,
    connect: str = "tls/127.0.0.1:7447",
    cameras: Sequence[str] = ("front",),
    server: str = "server",
    name: str = "fleet",
    hours: float = 24.0,
    policy: str = "",
) -> FleetFolder:
    """Make a fleet: an authority, a router, a server, and robots, each with a home of its own.

    Args:
        folder: where; holds no fleet yet.
        robots: how many, or their names.
        connect: where the router will be reached, protocol/host:port.
        cameras: names of each robot's cameras.
        hours: validity of the certificates.
        policy: more topics, as text of the policy file without its version.

    Raises:
        ConfigError: an impossible name or address.
        KeysError: the folder holds a fleet already.
    """
    endpoint = Endpoint.parse(connect)
    names = robot_names(robots) if isinstance(robots, int) else tuple(robots)
    text = fleet_policy(names, server, cameras) + policy
    if "router-1" in (*names, server) or "authority" in (*names, server):
        raise ConfigError('"router-1" and "authority" are the names of other folders')
    authority = Authority.create(folder / "authority", name)
    homes = [Home.create(folder / "router-1", "router-1", role=Role.ROUTER, addresses=(endpoint.host.strip("[]"),))]
    homes += [Home.create(folder / node, node) for node in (server, *names)]
    for home in homes:
        home.accept(authority.issue(home.request(), hours=hours))
    (folder / "authority" / "policy.toml").write_text(text, encoding="utf-8")
    bundles = authority.publish(hours=hours)
    for home in homes:
        home.accept(bundles[home.name])
        if home.role == Role.NODE:
            NetworkConfig((endpoint,)).save(home.path)
    return FleetFolder(folder / "authority", folder / "router-1", folder / server, tuple(folder / n for n in names))
