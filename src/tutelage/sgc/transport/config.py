"""Where the routers are, and how patient the network is: `network.toml` in a node's folder, and what Zenoh is told.

version = 1
routers = ["quic/robots.example.org:7447", "wss/robots.example.org:443", "tls/10.0.0.5:7447"]

The first router that answers carries everything; the others stand by. Whoever roams prefers QUIC, which survives a change of
address; TLS is faster for bulk; ws and wss pass where only web traffic does.
"""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tutelage.errors import ConfigError, MissingExtraError
from tutelage.files import write_atomic

if TYPE_CHECKING:
    import zenoh

FILE = "network.toml"
PROTOCOLS = ("tls", "quic", "ws", "wss")
_ENDPOINT = re.compile(r"(?P<protocol>\w+)/(?P<host>\[[0-9a-fA-F:.%]+\]|[A-Za-z0-9.-]+):(?P<port>\d{1,5})\Z")


@dataclass(frozen=True)
class Endpoint:
    """A router's address: protocol, host, port. Written as "tls/10.0.0.5:7447"."""

    protocol: str
    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Endpoint:
        """Read an address.

        Raises:
            ConfigError: not one.
        """
        found = _ENDPOINT.match(text) if isinstance(text, str) else None
        if not found or found["protocol"] not in PROTOCOLS or not int(found["port"]) < 65536:
            raise ConfigError(
                f"{text!r} is no address of a router; write it as protocol/host:port, protocol one of {', '.join(PROTOCOLS)}"
            )
        return cls(found["protocol"], found["host"], int(found["port"]))

    def __str__(self) -> str:
        return f"{self.protocol}/{self.host}:{self.port}"


@dataclass(frozen=True)
class Timers:
    """How soon a silent neighbour is given up, in seconds. Zenoh's own defaults take 12 to 20 s to notice.

    Attributes:
        lease: without a sign of life for so long, a connection is dead.
        opening: a router that has not answered by then is passed over.
        retry_first, retry_last: pause before the first and before every later attempt to connect.
        stall: if the network takes nothing for so long, the connection is closed and opened again.
    """

    lease: float = 1.5
    opening: float = 1.0
    retry_first: float = 0.2
    retry_last: float = 1.0
    stall: float = 1.5

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if not isinstance(value, int | float) or not 0.01 <= value <= 3600:
                raise ConfigError(f"timer {each.name} must be between 0.01 and 3600 seconds, not {value!r}")


@dataclass(frozen=True)
class Identity:
    """Files in PEM that prove to a router who we are, and to us who it is.

    Attributes:
        root: certificate of the authority.
        certificate: ours, with those between it and the root.
        key: its private key.
    """

    root: Path
    certificate: Path
    key: Path


@dataclass(frozen=True)
class NetworkConfig:
    """The file `network.toml`."""

    routers: tuple[Endpoint, ...]
    timers: Timers = field(default_factory=Timers)

    @classmethod
    def load(cls, folder: Path) -> NetworkConfig:
        """Read the file of a node's folder.

        Raises:
            ConfigError: no such file, or one that cannot be used; the message names it and the remedy.
        """
        path = folder / FILE
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise ConfigError(
                f'no {path}, so where are the routers? Write it with two lines: version = 1 and routers = ["tls/HOST:7447"]'
            ) from None
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path} cannot be read: {error}") from None
        try:
            return cls._of(table)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None

    @classmethod
    def _of(cls, table: dict[str, Any]) -> NetworkConfig:
        unknown = set(table) - {"version", "routers", "timers"}
        if unknown:
            raise ConfigError(f"unknown field {sorted(unknown)[0]!r}")
        if table.get("version") != 1:
            raise ConfigError(f"this program reads version 1, not {table.get('version')!r}")
        routers = table.get("routers")
        if not isinstance(routers, list) or not routers:
            raise ConfigError('routers must be a list with at least one address, such as ["tls/10.0.0.5:7447"]')
        timers = table.get("timers", {})
        unknown = set(timers) - {each.name for each in fields(Timers)} if isinstance(timers, dict) else {"timers"}
        if unknown:
            raise ConfigError(f"unknown timer {sorted(unknown)[0]!r}")
        return cls(tuple(map(Endpoint.parse, routers)), Timers(**timers))

    def save(self, folder: Path) -> Path:
        """Write the file, with the timers that differ from the defaults. Returns its path."""
        lines = ["version = 1", f"routers = {json.dumps([str(router) for router in self.routers])}"]
        changed = {f.name: getattr(self.timers, f.name) for f in fields(Timers) if getattr(self.timers, f.name) != f.default}
        if changed:
            lines += ["", "[timers]", *(f"{name} = {value}" for name, value in changed.items())]
        path = folder / FILE
        write_atomic(path, ("\n".join(lines) + "\n").encode())
        return path


def zenoh_settings(mode: str, timers: Timers, identity: Identity | None) -> dict[str, Any]:
    """What every Zenoh session here is told, as the tree of its configuration.

    Shared memory is off: between processes of one machine it would bypass TLS, and leave plaintext in /dev/shm after a
    crash. Scouting is off: nobody is found by asking around, and nothing is sent to multicast addresses.
    """
    tls: dict[str, Any] = {"enable_mtls": True, "close_link_on_expiration": True}
    if identity is not None:
        tls["root_ca_certificate"] = str(identity.root)
        for side in ("connect", "listen") if mode == "router" else ("connect",):
            tls[f"{side}_certificate"] = str(identity.certificate)
            tls[f"{side}_private_key"] = str(identity.key)
    return {
        "mode": mode,
        # The delay is spent waiting for answers to scouting, even if that is off: half a second at each start of a router.
        "scouting": {"delay": 1, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "adminspace": {"enabled": False},
        "plugins_loading": {"enabled": False},
        "connect": {
            "retry": {
                "period_init_ms": round(timers.retry_first * 1000),
                "period_max_ms": round(timers.retry_last * 1000),
                "period_increase_factor": 2,
            }
        },
        "transport": {
            "shared_memory": {"enabled": False},
            "unicast": {
                "open_timeout": round(timers.opening * 1000),
                "accept_timeout": round(timers.opening * 1000),
                "max_sessions": 10_000,
            },
            "link": {
                "tx": {
                    "lease": round(timers.lease * 1000),
                    "keep_alive": 4,
                    "queue": {"congestion_control": {"block": {"wait_before_close": round(timers.stall * 1e6)}}},
                },
                "tls": tls,
            },
        },
    }


def zenoh_config(settings: dict[str, Any]) -> zenoh.Config:
    """The tree as Zenoh's own object.

    Raises:
        MissingExtraError: Zenoh is not installed.
    """
    config: zenoh.Config = import_zenoh().Config.from_json5(json.dumps(settings))
    return config


def import_zenoh() -> Any:
    """The module.

    Raises:
        MissingExtraError: Zenoh is not installed.
    """
    try:
        import zenoh
    except ImportError:
        raise MissingExtraError("eclipse-zenoh", "sgc") from None
    return zenoh
