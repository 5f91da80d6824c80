"""Networks inside this machine: namespaces joined by a switch, with address translation in front of each site.

                    router 10.90.0.1
                         |
    --------------- switch, 10.90.0.0/16 ---------------
      |                   |                   |
    nat-a 10.90.1.1     nat-b 10.90.2.1     nat-c 10.90.3.1
    192.168.1.1         192.168.1.1         192.168.3.1
      |                   |                   |
    robot 192.168.1.2   server 192.168.1.2  robot's other interface, 192.168.3.2

Nothing here has a way off the machine. Needs root, iproute2 and nftables.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from functools import cache
from types import TracebackType
from typing import Self

ROUTER = "10.90.0.1"
SITES = {"a": ("10.90.1.1", "192.168.1"), "b": ("10.90.2.1", "192.168.1"), "c": ("10.90.3.1", "192.168.3")}
NAT = "add table ip lab; add chain ip lab out { type nat hook postrouting priority 100 ; }; "
NAT += "add rule ip lab out oifname wan masquerade"


@cache
def why_not() -> str:
    """Why this machine cannot do it; "" if it can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    missing = [tool for tool in ("ip", "nft") if shutil.which(tool) is None]
    if missing:
        return f"not installed: {', '.join(missing)} (Debian: iproute2, nftables)"
    probe = f"lab-probe-{os.getpid()}"
    try:
        _run("ip", "netns", "add", probe)
        _run("ip", "netns", "exec", probe, "nft", NAT)
    except subprocess.CalledProcessError as error:
        return f"namespaces or address translation are not permitted here: {error.stderr.decode().strip()}"
    finally:
        subprocess.run(["ip", "netns", "del", probe], capture_output=True, check=False)
    return ""


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, timeout=20)


class Lab:
    """The networks of the picture, from `__enter__` to `__exit__`."""

    def __init__(self) -> None:
        self._prefix = f"lab{os.getpid()}"
        self._made: list[str] = []

    def inside(self, place: str) -> list[str]:
        """The words before a command that is to run at a place: router, robot or server."""
        return ["ip", "netns", "exec", self._name(place)]

    def move_robot(self) -> None:
        """The robot leaves site a for site c: another interface, another address, another address translation in front."""
        self._at("robot", "ip", "addr", "flush", "dev", "eth-a")
        self._at("robot", "ip", "link", "set", "eth-a", "down")
        self._at("robot", "ip", "route", "replace", "default", "via", "192.168.3.1")

    def __enter__(self) -> Self:
        try:
            self._build()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for name in self._made:
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)
        self._made.clear()

    def _name(self, place: str) -> str:
        return f"{self._prefix}-{place}"

    def _at(self, place: str, *command: str) -> None:
        _run(*self.inside(place), *command)

    def _build(self) -> None:
        for place in ("switch", "router", "robot", "server", *(f"nat-{site}" for site in SITES)):
            _run("ip", "netns", "add", self._name(place))
            self._made.append(self._name(place))
            self._at(place, "ip", "link", "set", "lo", "up")
        self._at("switch", "ip", "link", "add", "br0", "type", "bridge")
        self._at("switch", "ip", "link", "set", "br0", "up")
        self._plug("router", "wan", f"{ROUTER}/16")
        for site, (outside, lan) in SITES.items():
            nat = f"nat-{site}"
            self._plug(nat, "wan", f"{outside}/16")
            self._at(nat, "sh", "-c", "echo 1 > /proc/sys/net/ipv4/ip_forward")
            self._at(nat, "nft", NAT)
            host = "server" if site == "b" else "robot"
            self._join(nat, "lan", f"{lan}.1/24", host, f"eth-{site}", f"{lan}.2/24")
        self._at("robot", "ip", "route", "add", "default", "via", "192.168.1.1")
        self._at("server", "ip", "route", "add", "default", "via", "192.168.1.1")

    def _plug(self, place: str, device: str, address: str) -> None:
        """A cable from a place to the switch."""
        self._join(place, device, address, "switch", f"to-{place}", None)
        self._at("switch", "ip", "link", "set", f"to-{place}", "master", "br0")

    def _join(self, one: str, device: str, address: str, other: str, its_device: str, its_address: str | None) -> None:
        _run(
            *self.inside(one), "ip", "link", "add", device, "type", "veth",
            "peer", "name", its_device, "netns", self._name(other),
        )  # fmt: skip
        for place, end, where in ((one, device, address), (other, its_device, its_address)):
            if where is not None:
                self._at(place, "ip", "addr", "add", where, "dev", end)
            self._at(place, "ip", "link", "set", end, "up")
