"""The way that the dissertation's earlier implementation went: SSH for commands, SFTP for images, a process for each robot.

OpenSSH's own client and server, with a server of our own on loopback: its own port, keys and configuration in a temporary
folder, which accepts one key. At each step a process for each robot sends the action over SSH; the program there writes the
image to the file system and says so; the image is fetched by SFTP and read. Two variants: connections that stay open all the
time, which is the best that can be done this way, and new ones for each step.
"""

from __future__ import annotations

import contextlib
import getpass
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from tutelage.errors import TutelageError
from tutelage.remote.steptime.ours import picture
from tutelage.sgc.ports import free_port

ROBOT = """
import sys
source, target = sys.argv[1:3]
image = open(source, "rb").read()
for action in sys.stdin:
    with open(target, "wb") as file:
        file.write(image)
    print("done", flush=True)
"""
"""The program on a robot: for each line, an action, write what the camera sees to the file system."""


def why_not() -> str:
    """Why this machine cannot do it; "" if it can."""
    missing = [tool for tool in ("ssh", "sftp", "ssh-keygen") if shutil.which(tool) is None]
    if _sshd() is None:
        missing.append("sshd")
    return f"not installed: {', '.join(missing)} (Debian: openssh-client, openssh-server)" if missing else ""


def measure(robots: int, steps: int, height: int, width: int, folder: Path, *, keep_open: bool) -> list[float]:
    """Seconds of each fleet step: an action to every robot, and the image after it from every robot.

    Raises:
        TutelageError: the server of SSH does not come up, or a robot fails.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with _server(folder) as port:
        (folder / "robot.py").write_text(ROBOT, encoding="utf-8")
        options = _options(folder, port)
        pipes, workers = [], []
        context = multiprocessing.get_context("spawn")
        for robot in range(robots):
            here, there = context.Pipe()
            (folder / f"camera-{robot}").write_bytes(picture(height, width, robot).tobytes())
            arguments = (there, options, folder, robot, (height, width, 3), keep_open)
            workers.append(context.Process(target=_robot, args=arguments, daemon=True))
            workers[-1].start()
            pipes.append(here)
        try:
            for pipe in pipes:
                _hear(pipe, 60.0)
            took = []
            for step in range(steps + 2):
                start = time.perf_counter()
                for pipe in pipes:
                    pipe.send([float(step % 2)] * 2)
                for pipe in pipes:
                    _hear(pipe, 60.0)
                took.append(time.perf_counter() - start)
            return took[2:]
        finally:
            for pipe in pipes:
                with contextlib.suppress(OSError):
                    pipe.send(None)
            for worker in workers:
                worker.join(5.0)
                worker.kill()


def _hear(pipe: Connection, timeout: float) -> None:
    if not pipe.poll(timeout):
        raise TutelageError("a robot on SSH does not answer")
    said = pipe.recv()
    if isinstance(said, str):
        raise TutelageError(f"a robot on SSH failed: {said}")


def _robot(
    pipe: Connection, options: list[str], folder: Path, robot: int, shape: tuple[int, int, int], keep_open: bool
) -> None:
    """The server's process for one robot."""
    remote, local = folder / f"image-{robot}", folder / f"fetched-{robot}"
    program = [sys.executable, str(folder / "robot.py"), str(folder / f"camera-{robot}"), str(remote)]
    try:
        with contextlib.ExitStack() as stack:
            shell = sftp = None
            if keep_open:
                shell = stack.enter_context(_talk(["ssh", *options, "127.0.0.1", " ".join(program)]))
                sftp = stack.enter_context(_talk(["sftp", "-q", "-b", "-", *_for_sftp(options), "127.0.0.1"]))
            pipe.send(0)
            while (action := pipe.recv()) is not None:
                line = " ".join(f"{number:.6f}" for number in action) + "\n"
                if shell is not None and sftp is not None:
                    _say(shell, line, "done")
                    _say(sftp, f"get {remote} {local}\n!echo fetched\n", "fetched")
                else:
                    once = ["ssh", *options, "127.0.0.1", " ".join(program)]
                    subprocess.run(once, input=line.encode(), check=True, capture_output=True, timeout=60)
                    fetch = ["sftp", "-q", "-b", "-", *_for_sftp(options), "127.0.0.1"]
                    get = f"get {remote} {local}\n".encode()
                    subprocess.run(fetch, input=get, check=True, capture_output=True, timeout=60)
                image = np.fromfile(local, np.uint8).reshape(shape)
                pipe.send(int(image[0, 0, 0]))
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        pipe.send(f"{type(error).__name__}: {error}")


@contextlib.contextmanager
def _talk(command: list[str]) -> Iterator[subprocess.Popen[str]]:
    program = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        yield program
    finally:
        program.kill()
        program.wait()


def _say(program: subprocess.Popen[str], line: str, until: str) -> None:
    assert program.stdin is not None
    assert program.stdout is not None
    program.stdin.write(line)
    program.stdin.flush()
    while True:
        heard = program.stdout.readline()
        if not heard:
            raise OSError("the connection ended")
        if heard.strip() == until:
            return


@contextlib.contextmanager
def _server(folder: Path) -> Iterator[int]:
    """An SSH server on loopback that accepts the key of this folder. Yields its port."""
    folder.chmod(0o700)
    for name in ("host", "key"):
        subprocess.run(
            ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(folder / name)], check=True, capture_output=True
        )
    if os.geteuid() == 0:
        Path("/run/sshd").mkdir(mode=0o755, exist_ok=True)  # which sshd asks for when it starts as root
    port = free_port()
    settings = folder / "sshd_config"
    settings.write_text(
        f"Port {port}\nListenAddress 127.0.0.1\nHostKey {folder / 'host'}\nAuthorizedKeysFile {folder / 'key.pub'}\n"
        "StrictModes no\nUsePAM no\nPasswordAuthentication no\nKbdInteractiveAuthentication no\nPermitRootLogin yes\n"
        f"PidFile none\nMaxStartups 100\nMaxSessions 100\nSubsystem sftp internal-sftp\nAllowUsers {getpass.getuser()}\n",
        encoding="utf-8",
    )
    log = (folder / "sshd.log").open("wb")
    program = subprocess.Popen([str(_sshd()), "-D", "-e", "-f", str(settings)], stdout=log, stderr=log)
    try:
        until = time.monotonic() + 10
        while subprocess.run(["ssh", *_options(folder, port), "127.0.0.1", "true"], capture_output=True).returncode:
            if program.poll() is not None or time.monotonic() > until:
                said = (folder / "sshd.log").read_text(errors="replace").strip().splitlines()
                raise TutelageError(f"no server of SSH could be started here: {said[-1] if said else 'it says nothing'}")
            time.sleep(0.1)
        yield port
    finally:
        program.kill()
        program.wait()
        log.close()


def _options(folder: Path, port: int) -> list[str]:
    known = ["-o", "StrictHostKeyChecking=accept-new", "-o", f"UserKnownHostsFile={folder / 'known_hosts'}"]
    quiet = ["-o", "BatchMode=yes", "-o", "LogLevel=ERROR", "-o", "IdentitiesOnly=yes"]
    return ["-F", "none", "-p", str(port), "-i", str(folder / "key"), *known, *quiet]


def _for_sftp(options: list[str]) -> list[str]:
    """sftp calls the port -P."""
    return ["-P" if word == "-p" else word for word in options]


def _sshd() -> str | None:
    return shutil.which("sshd", path=os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/usr/local/sbin"]))
