"""A router, robots and servers as processes of their own, for the tests. All of them end with the test."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sgc.fleets import eventually, free_port

import tutelage
from tutelage.remote.setup import FleetFolder, new_fleet

HERE = Path(__file__).parent
MAIN = "from tutelage.cli import main; main()"
SKEWED = "import time; a, b = time.time, time.time_ns; s = {skew}; time.time = lambda: a() + s; time.time_ns = lambda: b() + int(s * 1e9); "


@dataclass(frozen=True)
class Note:
    """A line of what a `Point` wrote down."""

    time: float
    what: str
    words: tuple[str, ...]


class Field:
    """A fleet in a folder; nothing runs at first."""

    def __init__(self, folder: Path, robots: int, policy: str = "") -> None:
        self.folder, self.port = folder, free_port()
        self.made: FleetFolder = new_fleet(folder / "fleet", robots, connect=f"tls/127.0.0.1:{self.port}", policy=policy)
        self.running: list[subprocess.Popen[bytes]] = []
        self.robots: dict[int, subprocess.Popen[bytes]] = {}
        """Those that should run, by number; see `revive`."""
        self.count = 0

    def revive(self) -> None:
        """Start all robots at 20 Hz that do not run."""
        for number in range(1, len(self.made.robots) + 1):
            if number not in self.robots or self.robots[number].poll() is not None:
                self.robots[number] = self.robot(number, "--hz", 20, wait=False)

    @property
    def server(self) -> Path:
        """Folder of the server's node."""
        return self.made.server

    def kill(self, number: int) -> None:
        """As by kill -9; returns when it is dead."""
        self.robots[number].kill()
        self.robots[number].wait()

    def router(self) -> subprocess.Popen[bytes]:
        """Start it."""
        return self.start("-c", MAIN, "router", self.made.router, "--listen", f"tls/127.0.0.1:{self.port}")

    def robot(
        self, number: int, *flags: object, env: str = "point:Point", skew: float = 0.0, wait: bool = True
    ) -> subprocess.Popen[bytes]:
        """Start one; numbers count from 1."""
        code = SKEWED.format(skew=skew) + MAIN if skew else MAIN
        command = ["-c", code, "robot", self.made.robots[number - 1], "--env", env, *flags]
        return self.start(*command, wait=wait, POINT_LOG=str(self.log(number)))

    def start(self, *arguments: object, wait: bool = True, **environment: str) -> subprocess.Popen[bytes]:
        """Start a program of Python, and wait until it says that Ctrl-C ends it."""
        self.count += 1
        output = self.folder / f"out-{self.count}.log"
        paths = os.pathsep.join([str(HERE), str(HERE.parent), str(Path(tutelage.__file__).parents[1])])
        settings = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", **environment}
        with output.open("wb") as file:
            program = subprocess.Popen(
                [sys.executable, *map(str, arguments)], stdout=file, stderr=subprocess.STDOUT, env=settings, cwd=self.folder
            )
        program.output = output  # type: ignore[attr-defined]
        self.running.append(program)
        if wait:
            eventually(lambda: "Ctrl-C" in output.read_text() or self._died(program), 30.0, every=0.02)
        return program

    def log(self, number: int) -> Path:
        """What a robot's `Point` writes down."""
        return self.folder / f"point-{number}.log"

    def notes(self, number: int, since: float = 0.0, *kinds: str) -> list[Note]:
        """What it wrote since then, by the monotonic clock of the machine; only of these kinds."""
        rows = [line.split() for line in self.log(number).read_text().rpartition("\n")[0].splitlines()]
        notes = [Note(float(row[0]), row[1], tuple(row[2:])) for row in rows]
        return [note for note in notes if note.time > since and (not kinds or note.what in kinds)]

    def moves(self, number: int, since: float) -> bool:
        """Has it got an action since then?"""
        return bool(self.notes(number, since, "act"))

    def _died(self, program: subprocess.Popen[bytes]) -> bool:
        assert program.poll() is None, said(program)
        return False

    def close(self) -> None:
        """End all."""
        for program in self.running:
            if program.poll() is None:
                program.send_signal(signal.SIGCONT)
                program.kill()
            program.wait()

    def __enter__(self) -> Field:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def said(program: subprocess.Popen[bytes]) -> str:
    """What a program printed."""
    return program.output.read_text()  # type: ignore[attr-defined,no-any-return]


def drive(step: Callable[[], object], until: Callable[[], object], timeout: float = 10.0) -> None:
    """Step a fleet until something is so, or fail."""
    end = time.monotonic() + timeout
    while not until():
        assert time.monotonic() < end, "it did not happen in time"
        step()
