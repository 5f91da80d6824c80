"""Policies, routers and patience for the tests of the network."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from sgc import members

from tutelage.sgc.home import Home
from tutelage.sgc.ports import free_port
from tutelage.sgc.router import Router, RouterConfig
from tutelage.sgc.rules import Role


def topic(alias: str, publish: Iterable[str], subscribe: Iterable[str], **fields: object) -> str:
    """A table of the policy; the first publisher owns the topic."""
    publish = list(publish)
    content = {
        "node": publish[0],
        "interface": f"/{alias}",
        "type": "std_msgs/msg/String",
        "owner": publish[0],
        "publish": publish,
        "subscribe": list(subscribe),
    }
    return table(alias, content | fields)


def service(alias: str, serve: Iterable[str], request: Iterable[str], **fields: object) -> str:
    """A table of the policy for a service; the first server owns it."""
    serve = list(serve)
    content = {
        "node": serve[0],
        "interface": f"/{alias}",
        "type": "std_srvs/srv/Trigger",
        "owner": serve[0],
        "kind": "service",
        "serve": serve,
        "request": list(request),
    }
    return table(alias, content | fields)


def table(alias: str, content: dict[str, object]) -> str:
    """As TOML."""
    lines = [
        f"{name} = {str(value).replace(chr(39), chr(34)) if isinstance(value, list) else _text(value)}"
        for name, value in content.items()
    ]
    return "\n".join(["", f"[topics.{alias}]", *lines, ""])


def _text(value: object) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value)


class Fleet(members.Fleet):
    """A fleet whose keys are still to be handed out, with routers. `fleet["arm"]` is a home."""

    def __init__(self, folder: Path, policy: str, nodes: Iterable[str], routers: Iterable[str] = ()) -> None:
        text = policy if "version = 1" in policy else f"version = 1\n{policy}"
        super().__init__(folder, nodes, text, share=False)
        for name in routers:
            self.join(name, Role.ROUTER)
        self.publish(text)

    def __getitem__(self, name: str) -> Home:
        return self.homes[name]


@contextmanager
def behind_a_router(folder: Path, policy: str, names: Sequence[str]) -> Iterator[Fleet]:
    """A fleet whose nodes dial out to a router that runs meanwhile, with TLS, and can read nothing."""
    fleet = Fleet(folder, policy, names, ["router"])
    address = f"tls/127.0.0.1:{free_port()}"
    for name in names:
        (fleet[name].path / "network.toml").write_text(f'version = 1\nrouters = ["{address}"]\n')
    with Router(fleet["router"], RouterConfig.of([address])):
        yield fleet


def eventually(condition: Callable[[], object], timeout: float = 10.0, every: float = 0.005) -> None:
    """Wait until the condition holds, or fail."""
    until = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < until, "it did not happen in time"
        time.sleep(every)


class Programs:
    """Programs of `beacon.py`, each in its own process; all end with the test."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.running: list[subprocess.Popen[bytes]] = []

    def start(self, *arguments: object, inside: Sequence[str] = ()) -> subprocess.Popen[bytes]:
        """Start one and wait until it is up. inside: words before the command, such as ip netns exec."""
        output = self.folder / f"{len(self.running)}-{arguments[0]}.log"
        command = [*inside, sys.executable, str(Path(__file__).with_name("beacon.py")), *map(str, arguments)]
        with output.open("wb") as file:
            program = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
        program.output = output  # type: ignore[attr-defined]
        self.running.append(program)
        eventually(lambda: "up\n" in output.read_text() or self._died(program), 30.0, every=0.02)
        return program

    def _died(self, program: subprocess.Popen[bytes]) -> bool:
        assert program.poll() is None, program.output.read_text()  # type: ignore[attr-defined]
        return False

    def close(self) -> None:
        """End all."""
        for program in self.running:
            program.kill()
            program.wait()

    def __enter__(self) -> Programs:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


@dataclass(frozen=True)
class Heard:
    """What a listener printed: numbers, when each came (seconds), and how many the subscription called lost."""

    numbers: list[int]
    times: list[float]
    lost: int

    @classmethod
    def of(cls, listener: subprocess.Popen[bytes]) -> Heard:
        """So far."""
        text = listener.output.read_text()  # type: ignore[attr-defined]
        rows = [line.split() for line in text.rpartition("\n")[0].splitlines()[1:] if line.count(" ") == 2]
        assert "Traceback" not in text, text
        return cls([int(row[0]) for row in rows], [float(row[1]) for row in rows], int(rows[-1][2]) if rows else 0)

    @property
    def in_order(self) -> bool:
        """Each number once, none missing, none out of order."""
        return self.numbers == list(range(self.numbers[0], self.numbers[0] + len(self.numbers)))

    def gap(self, since: float) -> float:
        """The longest silence after a moment, seconds."""
        times = [since, *(t for t in self.times if t >= since)]
        return max((b - a for a, b in zip(times, times[1:], strict=False)), default=float("inf"))
